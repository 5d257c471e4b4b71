"""Settings of identification: lifted functions, calibration of their parameters, regularisation and refinement."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator

from ..core.settings import Settings
from ..lifting import check_family


class LiftingSettings(Settings):
    """Lifted functions of the Koopman model; where none are declared, those that suit the plant that the reader names.

    `families` are tables, each with a ``kind``, whose formulas stand behind `functions`; `input_functions` are further inputs of the model.
    """

    functions: tuple[str, ...] | None = None
    families: tuple[dict[str, Any], ...] = ()
    input_functions: tuple[str, ...] = ()
    parameters: tuple[str, ...] | None = None

    @field_validator("families")
    @classmethod
    def _known(cls, value: tuple[dict[str, Any], ...]) -> tuple[dict[str, Any], ...]:
        for table in value:
            check_family(table)
        return value


class CalibrationSettings(Settings):
    """Phase calibration; ``None`` takes what suits the plant that the reader names."""

    angle: str | None = None
    ratio: float | None = Field(None, gt=0)
    reference: str | None = None
    measured: str | None = None
    settle_s: float = Field(0.1, ge=0)


class IdentifySettings(Settings):
    """Regularisation; ``auto`` is `alpha_factor` times the smallest coefficient that stabilises every model.

    At the smallest coefficient itself one unit has a pole on the stability limit, and no uncertainty model of the population is finite; the factor
    is doubled until the peak residual around the best nominal unit is at most `largest_residual`, where that can be reached.
    `refine` adds models that are refined on their free-run error, the population first, then each unit, held near the population's model by
    a prior that is never so weak that the peak residual exceeds `largest_residual`. Spectral radii stay below ``1 - margin``.
    """

    alpha: float | Literal["auto"] = "auto"
    alpha_factor: float = Field(4.0, ge=1)
    refine: bool = True
    largest_residual: float = Field(0.5, gt=0)
    margin: float = Field(0.0, ge=0, lt=1)

    @field_validator("alpha")
    @classmethod
    def _not_negative(cls, value: float | str) -> float | str:
        if isinstance(value, float) and value < 0:
            raise ValueError("alpha should be 'auto' or a number of at least 0")
        return value
