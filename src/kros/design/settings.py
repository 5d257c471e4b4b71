"""Settings of observer design: which methods, and with which baselines observers are compared."""

from __future__ import annotations

from typing import Literal, get_args

from pydantic import Field

from ..core.settings import Settings

METHODS = Literal["mixed", "paper", "worst_case_h2", "residual_h2", "estimator"]
BASELINES = Literal[
    "open_loop", "kalman_tuned", "ekf", "filtered_difference", "learned", "mean_profile", "boosting", "network"
]


class SynthesisSettings(Settings):
    """Observer synthesis."""

    methods: tuple[METHODS, ...] = Field(
        ("mixed", "worst_case_h2", "residual_h2", "estimator"),
        description="ways to an observer, each for every kind of model",
    )


class ObserverSettings(Settings):
    """Which observers are compared.

    The extended Kalman filter runs on the first lifted model (on a linear one it is the tuned Kalman filter);
    ``filtered_difference``, ``learned`` and ``mean_profile`` need no model. ``boosting`` and ``network`` are trained by
    scikit-learn, on demand: they take minutes.
    """

    baselines: tuple[BASELINES, ...] = Field(
        get_args(BASELINES)[:-2], description="observers to compare with; boosting and network on demand"
    )
