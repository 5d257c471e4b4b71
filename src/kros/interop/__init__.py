"""Bridges to scikit-learn and python-control. Each is imported when one of its names is first used.

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
    from .control import from_control, to_control
    from .sklearn_estimator import KoopmanRegressor

__all__ = ["KoopmanRegressor", "from_control", "to_control"]

_HOME = dict.fromkeys(__all__, "control") | {"KoopmanRegressor": "sklearn_estimator"}
__getattr__, __dir__ = lazy_names(__name__, _HOME)
