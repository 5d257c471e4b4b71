"""Load torque: from the current's error where the current is recorded, and by observers with a disturbance state where it is not.

`signals` knows what a mounted load does and how much of it can be seen; `from_current` is the paper's way; `calibrate` and `load_observer` give
the observer that learns from one known load how loads show, `disturbance` the one that takes it from a model; `level` brings back what
no measurement holds; `accuracy` judges all of them.
"""

from .accuracy import LoadAccuracy, load_accuracy, ripple_power
from .calibrate import LoadCalibration, calibrate_load
from .disturbance import disturbance_observer, load_direction
from .from_current import TorqueScale, calibrate_torque, load_from_current
from .level import AngleLoad, LoadAndCurrent, RunningAngleLoad
from .load_observer import load_observer
from .signals import known_load, low_passed, without_level

__all__ = [
    "AngleLoad",
    "LoadAccuracy",
    "LoadAndCurrent",
    "LoadCalibration",
    "RunningAngleLoad",
    "TorqueScale",
    "calibrate_load",
    "calibrate_torque",
    "disturbance_observer",
    "known_load",
    "load_accuracy",
    "load_direction",
    "load_from_current",
    "load_observer",
    "low_passed",
    "ripple_power",
    "without_level",
]
