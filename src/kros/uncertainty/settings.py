"""Settings of quantification: form, nominal, order and outliers; and how weights are fitted and checked."""

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
    """Uncertainty model and outlier scores: the keys of a study."""

    form: FORMS = Field("inverse_input_multiplicative", description="of the uncertain set")
    n_freqs: int = Field(1000, ge=50, description="points of the frequency grid")
    outlier_form: FORMS = Field("additive", description="of the residuals that outlier scores are made of")


class QuantifySettings(UncertaintySettings):
    """What `kros.quantify` takes beside models; a study has the defaults of what is no key of it."""

    nominal: str | None = Field(
        None,
        description="a unit; by default the best one, and observers that are free to may have the mean of the units",
    )
    max_order: int = Field(4, ge=1, le=8, description="largest order of an entry of a weight")
    tolerance_db: float = Field(1.0, gt=0, description="how far a weight may be above the bound of the residuals")
    false_alarm_rate: float = Field(
        1e-2, gt=0, lt=1, description="probability with which a unit like the others is flagged"
    )


class FitSettings(Settings):
    """How diagonal weights are fitted and checked; none of it bears on soundness, which the proof at the end decides."""

    points: int = Field(160, ge=8, description="frequencies of the joint fit: what is missed between them joins it")
    units: int = Field(4, ge=1, description="largest residuals of a frequency in the joint fit; the check sees all")
    temperatures: tuple[float, ...] = Field(
        (0.1, 0.03, 0.01, 0.003), min_length=1, description="nepers, of the smoothed maxima; the last is 0.03 dB"
    )
    steps: int = Field(10, ge=1, description="largest number of steps at one temperature")
    pull: float = Field(1e-3, gt=0, description="towards the start, nepers: small, and it makes the optimum unique")
    peak_price: float = Field(0.05, ge=0, description="of the peak of square weights, which decides among equal covers")
    gain: float = Field(0.1, gt=0, lt=1, description="of the tolerance: what a higher order of an entry has to bring")
    enough: float = Field(0.9, gt=0, le=1, description="of the tolerance, within which an order is good enough")
    density: int = Field(10, ge=1, description="points of the check for every one of the grid; modes join them")
    rounds: int = Field(5, ge=1, description="fits, each with the frequencies and units missed by the one before")
    missed_db: float = Field(0.05, gt=0, description="cost between the points of the fit that brings further ones")
    deficit: float = Field(1.02, gt=1, description="ratio up to which a weight is lifted; beyond it is fitted again")
    block: int = Field(
        200, ge=2, description="units at once: of more, those that decide are fitted and all are checked"
    )
