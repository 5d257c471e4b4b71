"""Settings of observer design: which methods, what they assume, and which observer is deployed."""

from __future__ import annotations

from typing import Literal, get_args

from pydantic import Field

from ..core.settings import Settings

METHODS = Literal["mixed", "paper", "worst_case_h2", "residual_h2", "estimator"]
BASELINES = Literal["open_loop", "kalman_tuned", "ekf", "filtered_difference", "learned", "mean_profile"]


class SynthesisSettings(Settings):
    """Observer synthesis."""

    methods: tuple[METHODS, ...] = Field(
        ("mixed", "worst_case_h2", "residual_h2", "estimator"),
        description="ways to an observer, each for every kind of model",
    )
    input_weight: float | Literal["tuned", "identity"] = Field(
        "tuned", description="corner of the low-pass spectrum of the inputs in Hz"
    )
    penalty: float = Field(1e-3, gt=0, description="on the correction, relative to the error")
    time_limit_s: float = Field(60.0, gt=0, description="for the optimisation of mixed")


class ObserverSettings(Settings):
    """Which observers are compared, and which one is deployed.

    The extended Kalman filter runs on the first lifted model (on a linear one it is the tuned Kalman filter); ``filtered_difference``,
    ``learned`` and ``mean_profile`` need no model.
    """

    baselines: tuple[BASELINES, ...] = Field(get_args(BASELINES), description="observers to compare with")
    deployed: str | None = Field(
        None,
        description="name of the observer that is deployed; by default the most accurate that has all certificates and tolerates dropouts",
    )
    false_alarm_rate: float = Field(
        0.02, gt=0, lt=1, description="share of good machines that the monitor of the deployed observer may report"
    )
