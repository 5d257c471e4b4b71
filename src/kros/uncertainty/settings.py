"""Settings of quantification: form, structure and order of the weights, and outlier scores."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

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

    form: FORMS = "inverse_input_multiplicative"
    nominal: str | None = Field(
        None, description='a unit, or "unit" for the best one; by default observers that are free to may have the mean of the units instead'
    )
    structure: Literal["auto", "diagonal", "scalar", "entrywise"] = "auto"
    n_freqs: int = Field(1000, ge=50)
    max_order: int = Field(4, ge=1, le=8)
    tolerance_db: float = Field(1.0, gt=0)
    drop_outliers: bool = False
    outlier_form: FORMS = "additive"
    false_alarm_rate: float = Field(3e-3, gt=0, lt=1)

    @field_validator("structure", mode="before")
    @classmethod
    def _known(cls, value: str) -> str:
        if value == "full":
            raise ValueError("full weights are no longer there; choose 'auto' or 'diagonal', whose sets are somewhat larger")
        return value
