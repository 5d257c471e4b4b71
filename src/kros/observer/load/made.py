"""The observer that learned from a known load how loads show: total current and load torque are separate states of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy.typing as npt

from ..memory import tune_memory
from ..memory.made import embedded
from ..memory.past import hidden_of
from ..observer import Observer
from .calibrate import LoadCalibration


def load_observer(
    name: str,
    calibration: LoadCalibration,
    inputs: Sequence[str],
    memories: int = 8,
    importance: npt.ArrayLike = 1.0,
    samples: int = 6000,
    iterations: int = 0,
) -> Observer:
    """Return an observer with the recorded states, ``load``, and ``memory_1, ...``, which needs neither current nor load at run time.

    Parameters
    ----------
    name : str
    calibration : LoadCalibration
    inputs : sequence of str
    memories : int
    importance : array_like, shape (h,)
        Weights of the hidden states' errors, the load's last.
    samples : int
        The first so many of every recording are tuned on.
    iterations : int
        Most steps of tuning; none leaves the observer as reduced.

    Returns
    -------
    Observer
        It runs, is saved and certified (`relift_certificate`) as all are. `load`, and under load the current, lack their level (`AngleLoad`).
    """
    past = calibration.past
    model = past.model(len(hidden_of(past.lifting, past.measured)) + memories, importance=importance)
    x, u = calibration.states[:samples], calibration.inputs[:samples]
    if iterations:
        model, _ = tune_memory(model, past, x, u, calibration.kinds, calibration.parameters, importance, iterations=iterations)
    return embedded(name, past, model, inputs, x, u, calibration.sample_period_s, calibration.parameters or None)
