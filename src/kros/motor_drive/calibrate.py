r"""How a known load shows in what an observer sees, collected from recordings of a few units.

The load is one more hidden state, the last: zero in recordings without load, known in the others. Both kinds count alike, however many
there are. What is regressed is the part that can be seen (`without_level`), of the load and, since under load the level is missing there too, of the current:

.. math:: \tau_s, \qquad i - (\tau - \tau_s).

The estimator's bank has one lag with the same forgetting: the integral of the tracking error, which the drive's controller holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, DimensionError
from ..data import EpisodeBatch
from ..data.population import EpisodeKey
from ..lifting import Lifting
from ..observer import EstimatorSettings, Observer, Recordings, identify_estimator
from .signals import low_passed, without_level

Array = npt.NDArray[np.float64]
LOAD = "load"
_LOADED, _UNLOADED = "loaded", "unloaded"


@dataclass(frozen=True, eq=False)
class LoadCalibration:
    """What recordings under a known load say; `load_observer` makes observers of it.

    Parameters
    ----------
    lifting : Lifting
        Of the recorded states and the load.
    measured : tuple of int
    batch : EpisodeBatch
        Recorded states, the load's share taken off the current, and the load, both as far as they can be seen; its conditions end with "loaded" and "unloaded".
    level_s : float
        Time after which a constant load is forgotten.
    used, left_out : tuple of int
        Episodes that count, and those in which the current came to its limit.

    Examples
    --------
    >>> import kros
    >>> from kros.data import EpisodeBatch
    >>> from kros.lifting import Lifting
    >>> from kros.motor_drive import calibrate_load
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=1, seconds=2.0, seed=3).simulate().population
    >>> batch = EpisodeBatch.read(motors, motors.keys())
    >>> load = 0.01 * abs(batch.states[..., 0]) * [0, 1]  # the second episode carries a load
    >>> calibration = calibrate_load(Lifting(motors.states), (0,), batch, load)
    >>> calibration.used, calibration.left_out
    ((0, 1), ())
    """

    lifting: Lifting
    measured: tuple[int, ...]
    batch: EpisodeBatch
    level_s: float
    used: tuple[int, ...]
    left_out: tuple[int, ...]


def calibrate_load(
    lifting: Lifting,
    measured: Sequence[int],
    batch: EpisodeBatch,
    load: Array,
    current: int | None = None,
    level_s: float = 10.0,
    corner_hz: float | None = None,
    limit: float | None = None,
) -> LoadCalibration:
    """Collect how a known load shows.

    Parameters
    ----------
    lifting : Lifting
        Of the recorded states; its functions read measured ones alone.
    measured : sequence of int
    batch : EpisodeBatch
        Recordings of equal length that start at rest, with and without load.
    load : ndarray, shape (n_samples, batch)
        Torque of the known load in any unit, zero in recordings without load.
    current : int, optional
        State that carries the load, in the load's unit; None where none does, or the units differ.
    level_s : float, s
    corner_hz : float, optional
        What is faster in the known load, vibrations of the gear for instance, does not count as load.
    limit : float, optional
        Episodes in which the current comes so far are left out: a controller at its limit no longer does what its errors say.

    Raises
    ------
    DimensionError
        When shapes do not fit, or a state is named "load".
    DataError
        When recordings of a kind are missing, or all come to the limit.

    Examples
    --------
    >>> import kros
    >>> from kros.data import EpisodeBatch
    >>> from kros.lifting import Lifting
    >>> from kros.motor_drive import calibrate_load
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=1, seconds=2.0, seed=3).simulate().population
    >>> batch = EpisodeBatch.read(motors, motors.keys())
    >>> load = 0.01 * abs(batch.states[..., 0]) * [0, 1]  # the second episode carries a load
    >>> calibrate_load(Lifting(motors.states), (0,), batch, load, level_s=5.0).level_s
    5.0
    """
    states, dt = batch.states, batch.sample_period_s
    if states.shape[:2] != load.shape or LOAD in lifting.states:
        raise DimensionError(
            f"Load calibration: states {states.shape} and load {load.shape} should agree in (n_samples, batch), "
            f"and no state be named {LOAD!r}, found {', '.join(lifting.states)}."
        )
    at_limit = (
        np.zeros(load.shape[1], bool)
        if limit is None or current is None
        else np.abs(states[..., current]).max(axis=0) >= limit
    )
    used = np.flatnonzero(~at_limit)
    loaded = np.any(load[:, used] != 0, axis=0)
    if not loaded.any() or loaded.all():
        raise DataError(
            f"Load calibration: needs recordings with and without load, found {int(loaded.sum())} and {int((~loaded).sum())} that count; "
            f"{int(at_limit.sum())} of {len(at_limit)} come to the current's limit; take a smaller load or slower moves."
        )
    torque = load[:, used] if corner_hz is None else low_passed(load[:, used], corner_hz, dt)
    seen = without_level(torque, level_s, dt)
    widened = np.concatenate([states[:, used], seen[..., None]], axis=-1)
    if current is not None:
        widened[..., current] -= load[:, used] - without_level(load[:, used], level_s, dt)
    with_load = replace(lifting, states=(*lifting.states, LOAD))
    kinds = [
        _LOADED if on else _UNLOADED for on in loaded
    ]  # of one unit: those with a known load are too few to leave out
    keys = tuple(EpisodeKey("", kind, str(i)) for i, kind in zip(used, kinds, strict=True))
    seen_batch = replace(batch.take(used.tolist()), keys=keys, states=widened, shown=None, lost=None)
    at = tuple(np.flatnonzero(at_limit).tolist())
    return LoadCalibration(with_load, tuple(measured), seen_batch, level_s, tuple(used.tolist()), at)


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
        By default with delays of 20 samples and one lag, as slow as the level of a load is forgotten.

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
    lag = calibration.level_s / batch.sample_period_s
    if settings is None:  # few recordings have a known load
        settings = EstimatorSettings(dense=20, longest=20, first_lag=lag, last_lag=lag / recordings.length)
    found = identify_estimator(
        name, calibration.lifting, calibration.measured, inputs, recordings, batch.sample_period_s, None, settings
    )
    return found.observer
