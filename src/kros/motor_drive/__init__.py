"""Load torque: from the error of a recorded current, or by observers with a disturbance state.

`signals` computes what a mounted load does and how much of it can be seen; `from_current` is the paper's way;
`calibrate` gives the observer that learns from one known load how loads show; `level` brings back
what no measurement holds; `load_accuracy` judges all of them.

Examples
--------
>>> import numpy as np
>>> from kros.motor_drive import known_load
>>> known_load([0.0, np.pi / 2], 0.001, moment=0.2).round(9).tolist()  # a mass that hangs, and one held out
[0.0, 0.2]
"""

from .calibrate import LoadCalibration, calibrate_load, load_observer
from .from_current import TorqueScale, calibrate_torque, load_from_current
from .level import AngleLoad
from .signals import known_load

__all__ = [
    "AngleLoad",
    "LoadCalibration",
    "TorqueScale",
    "calibrate_load",
    "calibrate_torque",
    "known_load",
    "load_from_current",
    "load_observer",
]
