"""Bridges to scikit-learn, pykoop and python-control. Each is imported when one of its names is first used.

Examples
--------
>>> import control
>>> from kros.interop import from_control
>>> lag = from_control(control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01))
>>> lag.A.tolist(), lag.dt
([[0.5]], 0.01)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import lazy_names

if TYPE_CHECKING:
    from .adopted import AdoptedModel
    from .control import UncertaintyForControl, from_control, models_to_control, to_control, uncertainty_to_control
    from .models import quantify_models
    from .pykoop import from_pykoop
    from .pykoop_population import models_from_pykoop
    from .rows import one_step_pairs
    from .sklearn_estimator import KoopmanRegressor

_HOME = {
    **dict.fromkeys(("UncertaintyForControl", "from_control", "models_to_control", "to_control", "uncertainty_to_control"), "control"),
    "AdoptedModel": "adopted",
    "quantify_models": "models",
    "KoopmanRegressor": "sklearn_estimator",
    "from_pykoop": "pykoop",
    "models_from_pykoop": "pykoop_population",
    "one_step_pairs": "rows",
}

__all__ = [
    "AdoptedModel",
    "KoopmanRegressor",
    "UncertaintyForControl",
    "from_control",
    "from_pykoop",
    "models_from_pykoop",
    "models_to_control",
    "one_step_pairs",
    "quantify_models",
    "to_control",
    "uncertainty_to_control",
]

__getattr__, __dir__ = lazy_names(__name__, _HOME, __all__)
