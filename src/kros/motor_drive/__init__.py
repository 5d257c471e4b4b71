"""Load torque: from the error of a recorded current, or by observers with the load as a state.

`signals` computes what a mounted load does and which part of it can be seen; `from_current` is the paper's way;
`observer` makes the estimator from one known load; `level` brings back what no measurement holds.

Examples
--------
>>> import numpy as np
>>> from kros.motor_drive import known_load
>>> known_load([0.0, np.pi / 2], 0.001, moment=0.2).round(9).tolist()  # a mass that hangs, and one held out
[0.0, 0.2]
"""

from ..core.removed import refusing
from .level import AngleLoad
from .observer import LoadSettings, load_observer
from .signals import TorqueScale, known_load

__all__ = ["AngleLoad", "LoadSettings", "TorqueScale", "known_load", "load_observer"]
__getattr__ = refusing(__name__)
