"""Settings of identification: lifted functions, calibration of their parameters, regularisation and refinement."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from ..core import Names, Record, Settings
from ..lifting.families import check_family


class LiftingSettings(Settings):
    """Lifted functions of the Koopman model; where none are declared, those that suit the plant that the reader names.

    `families` are tables, each with a ``kind``, whose formulas stand behind `functions`; `input_functions` are further
    inputs of the model.
    """

    functions: Names | None = Field(None, description="lifted functions of the states, as formulas")
    families: tuple[Record, ...] = Field((), description="tables with a kind, whose formulas follow the functions")
    input_functions: Names = Field((), description="further inputs of the model, of states and inputs")

    @field_validator("families")
    @classmethod
    def _known(cls, value: tuple[Record, ...]) -> tuple[Record, ...]:
        for table in value:
            check_family(table)
        return value


class CalibrationSettings(Settings):
    """Phase calibration; ``None`` takes what suits the plant that the reader names."""

    angle: str | None = Field(None, description="state in the periodic function; default: that of the formula")
    ratio: float | None = Field(None, gt=0, description="periods a radian; default: that of the formula, such as 100")
    reference: str | None = Field(None, description="commanded speed, constant for a while in segments that are used")
    measured: str | None = Field(None, description="speed that follows it and shows the periodic error")


class IdentifySettings(Settings):
    """Regularisation; ``auto``: a multiple of the smallest coefficient that stabilises every model (`AlphaSearch`).

    At the smallest coefficient itself one unit has a pole on the stability limit, and no uncertainty model of the
    population is finite; the factor is doubled until the peak residual around the best nominal unit is at most one
    half, where that can be reached. `refine` replaces these models by ones that are refined on their free-run error,
    the population first, then each unit, held near the population's model by a prior. Its strength is chosen on
    left-out episodes.
    """

    alpha: Annotated[float, Field(ge=0)] | Literal["auto"] = Field(
        "auto",
        description="regularisation of channels divided by their ranges; a number: of recorded units, as in the paper",
    )
    refine: bool = Field(True, description="models refined on their free-run error, in place of those of the paper")
