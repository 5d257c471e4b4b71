"""Bridges to scikit-learn and python-control. Each is imported when one of its names is first used.

Examples
--------
>>> import control
>>> from kros.interop import from_control
>>> lag = from_control(control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01))
>>> lag.A.tolist(), lag.dt
([[0.5]], 0.01)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .control import from_control, to_control
    from .sklearn_estimator import KoopmanRegressor

__all__ = ["KoopmanRegressor", "from_control", "to_control"]


def __getattr__(name: str) -> Any:
    """Import a bridge on first use (PEP 562)."""
    if name in __all__:
        module = "sklearn_estimator" if name == "KoopmanRegressor" else "control"
        return getattr(import_module(f".{module}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
