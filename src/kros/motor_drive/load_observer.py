"""The observer that learned from a known load how loads show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..observer.observer import Observer
from ..observer.predictor.build import embedded
from ..observer.predictor.moments import hidden_of
from ..observer.predictor.tuning import tune_predictor
from .calibrate import LoadCalibration

_OTHERS = 0.1  # weight of the recorded states' errors beside the load's


def load_observer(
    name: str,
    calibration: LoadCalibration,
    inputs: Sequence[str],
    internal: int = 8,
    deviation: float = 0.15,
    samples: int = 6000,
    iterations: int = 10,
) -> Observer:
    """Return an observer with the recorded states, ``load`` and ``memory_1, ...``, without current or load as inputs.

    Parameters
    ----------
    name : str
    calibration : LoadCalibration
    inputs : sequence of str
    internal : int
        States besides the recorded ones and the load.
    deviation : float
        Share by which the lifted functions' effect may differ from machine to machine.
    samples : int
        The first so many of every recording are tuned on.
    iterations : int
        Most steps of tuning; none leaves the observer as reduced.

    Returns
    -------
    Observer
        It runs, is saved and certified (`relift_certificate`) as all are. `load`, and under load the current, lack
        their level (`AngleLoad`).

    Examples
    --------
    >>> import kros
    >>> from kros.data import EpisodeBatch
    >>> from kros.lifting import Lifting
    >>> from kros.motor_drive import calibrate_load, load_observer
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=1, seconds=2.0, seed=3).simulate().population
    >>> batch = EpisodeBatch.read(motors, motors.keys())
    >>> load = 0.01 * abs(batch.states[..., 0]) * [0, 1]  # the second episode carries a load
    >>> calibration = calibrate_load(Lifting(motors.states), (0,), batch, load)
    >>> load_observer("motor/load", calibration, motors.inputs, internal=2, iterations=0).lifting.states
    ('position', 'velocity', 'current', 'load', 'memory_1', 'memory_2')
    """
    past = calibration.past
    hidden = len(hidden_of(past.lifting, past.measured))
    importance = np.append(np.full(hidden - 1, _OTHERS), 1.0)
    model, batch = (
        past.model(hidden + internal, importance=importance, deviation=deviation),
        calibration.batch.head(samples),
    )
    if iterations:
        model, _ = tune_predictor(model, past, batch, importance, deviation, iterations=iterations)
    return embedded(name, past, model, inputs, batch)
