"""Settings of observer design: which methods, and with which baselines observers are compared."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

from pydantic import Field

from ..core import Settings
from ..observer.baselines.learned import Regressor
from .baselines import BASELINES
from .methods import METHODS

if TYPE_CHECKING:  # the names are those of the registries, which a type checker does not know
    MethodName = str
    BaselineName = str
else:
    MethodName = Literal[tuple(method.name for method in METHODS if not method.label.baseline)]
    BaselineName = Literal[(*(method.name for method in METHODS if method.label.baseline), *BASELINES)]


class SynthesisSettings(Settings):
    """Observer synthesis."""

    methods: tuple[MethodName, ...] = Field(
        ("mixed", "worst_case_h2", "residual_h2", "estimator"),
        description="ways to an observer, each for every kind of model",
    )


class ObserverSettings(Settings):
    """Which observers are compared.

    The extended Kalman filter runs on the first lifted model (on a linear one it is the tuned Kalman filter);
    ``filtered_difference``, ``learned`` and ``mean_profile`` need no model. ``boosting`` and ``network`` are trained by
    scikit-learn, on demand: they take minutes.
    """

    baselines: tuple[BaselineName, ...] = Field(
        tuple(name for name in get_args(BaselineName) if name not in get_args(Regressor)),
        description="observers to compare with; boosting and network on demand",
    )
