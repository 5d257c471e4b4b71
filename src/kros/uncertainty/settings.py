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
    """Uncertainty model and outlier scores."""

    form: FORMS = Field("inverse_input_multiplicative", description="of the uncertain set")
    nominal: str | None = Field(
        None,
        description='a unit, or "unit" for the best one; by default observers that are free to may have the mean of '
        "the units instead",
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


class FitSettings(Settings):
    """How diagonal weights are fitted and checked; none of it bears on soundness, which the proof at the end decides.

    Examples
    --------
    >>> from kros.uncertainty import FitSettings
    >>> FitSettings(points=300).points
    300
    """

    points: int = Field(160, ge=8, description="frequencies of the joint fit: what is missed between them joins it")
    units: int = Field(4, ge=1, description="largest residuals of a frequency in the joint fit; the check sees all")
    pull: float = Field(0.03, gt=0, description="of the start's cover towards equal entries: smooth, and near optimal")
    temperatures: tuple[float, ...] = Field(
        (0.1, 0.05, 0.012, 0.003), min_length=2, description="nepers, of the smoothed maxima; the last is 0.03 dB"
    )
    steps: int = Field(10, ge=1, description="largest number of steps at one temperature")
    settled: float = Field(0.02, gt=0, description="gain of a step, in temperatures, at which the temperature falls")
    exchanges: int = Field(12, ge=0, description="largest number of moves between local optima")
    stalled: float = Field(0.97, gt=0, lt=1, description="share of the excess above which a move was the last")
    corners: int = Field(60, ge=2, description="places at which further poles and zeros are tried")
    enough: float = Field(
        0.95, gt=0, le=1, description="of the tolerance at which a fit ends: the check costs the rest"
    )
    weak_db: float = Field(6.0, gt=0, description="range up to which a pole and a zero are tried to be left out")
    peak_price: float = Field(0.05, ge=0, description="of the peak of square weights, which decides among equal covers")
    density: int = Field(10, ge=1, description="points of the check for every one of the grid; modes join them")
    rounds: int = Field(4, ge=1, description="fits, each with the frequencies and units missed by the one before")
    missed_db: float = Field(0.05, gt=0, description="cost between the points of the fit that brings further ones")
    deficit: float = Field(1.02, gt=1, description="ratio up to which a weight is lifted; beyond it is fitted again")
    block: int = Field(
        200, ge=2, description="units at once: of more, those that decide are fitted and all are checked"
    )
