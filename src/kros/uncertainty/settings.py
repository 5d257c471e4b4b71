"""Settings of quantification: form, structure and order of the weights, and outlier scores."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from ..core.settings import Settings

FORMS = Literal[
    "additive",
    "input_multiplicative",
    "output_multiplicative",
    "inverse_additive",
    "inverse_input_multiplicative",
    "inverse_output_multiplicative",
]


class UncertaintySettings(Settings):
    """Uncertainty model and outlier scores."""

    form: FORMS = Field("inverse_input_multiplicative", description="of the uncertain set")
    nominal: str | None = Field(
        None,
        description='a unit, or "unit" for the best one; by default observers that are free to may have the mean of the units instead',
    )
    n_freqs: int = Field(1000, ge=50, description="points of the frequency grid")
    max_order: int = Field(4, ge=1, le=8, description="largest order of an entry of a weight")
    tolerance_db: float = Field(1.0, gt=0, description="how far a weight may be above the bound of the residuals")
    drop_outliers: bool = Field(
        False, description="units that are flagged take no part in models, weights and synthesis"
    )
    outlier_form: FORMS = Field("additive", description="of the residuals that outlier scores are made of")
    false_alarm_rate: float = Field(
        1e-2, gt=0, lt=1, description="probability with which a unit like the others is flagged"
    )
