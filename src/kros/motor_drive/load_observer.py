"""The observer that learned from a known load how loads show: total current and load torque are separate states of it."""

from __future__ import annotations

from collections.abc import Sequence

from ..observer import EstimatorSettings, Observer, Recordings, identify_estimator
from .calibrate import LoadCalibration


def load_observer(
    name: str, calibration: LoadCalibration, inputs: Sequence[str], settings: EstimatorSettings | None = None
) -> Observer:
    """Return the estimator of the recorded states and ``load``, which needs neither current nor load at run time.

    Parameters
    ----------
    name : str
    calibration : LoadCalibration
    inputs : sequence of str
    settings : EstimatorSettings, optional
        By default with lags up to the time after which the level of a load is forgotten.

    Returns
    -------
    Observer
        It runs and is saved as all are. `load`, and under load the current, lack their level (`AngleLoad`).

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
    >>> load_observer("motor/load", calibration, motors.inputs).recorded
    ('position', 'velocity', 'current', 'load')
    """
    batch = calibration.batch
    place = {key: i for i, key in enumerate(batch.keys)}
    recordings = Recordings.of(batch.keys, lambda key: batch.take([place[key]]).head(int(batch.lengths[place[key]])))
    longest = calibration.level_s / batch.sample_period_s / recordings.length
    settings = settings or EstimatorSettings(last_lag=longest)
    found = identify_estimator(
        name, calibration.lifting, calibration.measured, inputs, recordings, batch.sample_period_s, None, settings
    )
    return found.observer
