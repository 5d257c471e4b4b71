"""Load torque: from the error of a recorded current, or by observers with the load as a state.

`signals` computes what a mounted load does and which part of it can be seen, `observer` makes the estimator from one
known load, and `level` brings back what no measurement holds.

Examples
--------
>>> from kros.motor_drive import AngleLoad
>>> round(AngleLoad(level_s=10.0, sample_period_s=0.001).pole, 4)
0.9999
"""

from .level import AngleLoad

__all__ = ["AngleLoad"]
