r"""The load as one more hidden state: an estimator made from recordings of a few units under a known load.

The load is the last state: zero in recordings without load, known in the others. Both kinds count alike, however many
there are. The estimator is regressed on the part that can be seen (`without_level`) of the load and, since under load
the level is missing there too, of the current:

.. math:: \tau_s, \qquad i - (\tau - \tau_s).

Its bank has one lag with the same forgetting: the integral of the tracking error, which the drive's controller holds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..core import Array, DataError, DimensionError
from ..data import EpisodeBatch, EpisodeKey
from ..lifting import Lifting
from ..observer import EstimatorSettings, Observer, Recordings, identify_estimator
from .signals import low_passed, without_level

LOAD = "load"


@dataclass(frozen=True)
class LoadSettings:
    """How a known load is read."""

    current: int  # state that carries the load, in the load's unit
    level_s: float = 10.0  # s; time after which a constant load is forgotten
    corner_hz: float = 20.0  # what is faster in the known load, such as vibrations of the gear, is no load
    limit: float = np.inf  # of the current; episodes that reach it are left out
    delays: int = 20  # of the estimator, in samples: few recordings have a known load
    restart_share: float = 1e-9  # of the estimator, at all times; the load of the first sample is in its tracking error


def load_observer(
    name: str,
    lifting: Lifting,
    measured: Sequence[int],
    inputs: Sequence[str],
    batch: EpisodeBatch,
    load: Array,
    settings: LoadSettings,
) -> tuple[Observer, tuple[int, ...]]:
    """Return the estimator of the recorded states and ``load``, and the episodes whose current reaches its limit.

    The functions of the lifting read measured states alone, and so does it at run time. `load`, (n_samples, batch), is
    zero in recordings without load; the estimated one and, under load, the current lack their level (`AngleLoad`).
    """
    if batch.states.shape[:2] != load.shape or LOAD in lifting.states:
        raise DimensionError(
            f"Load observer: states {batch.states.shape} and load {load.shape} should agree in (n_samples, batch), "
            f"and no state be named {LOAD!r}, found {', '.join(lifting.states)}."
        )
    # where the controller does not do what its errors say
    at_limit = np.abs(batch.states[..., settings.current]).max(axis=0) >= settings.limit
    used = np.flatnonzero(~at_limit)
    visible = _visible(batch.take(used.tolist()), load[:, used], int(at_limit.sum()), settings)
    place = {key: i for i, key in enumerate(visible.keys)}
    recordings = Recordings.of(visible.keys, lambda k: visible.take([place[k]]).head(int(visible.lengths[place[k]])))
    lag = settings.level_s / batch.sample_period_s
    estimator = EstimatorSettings(
        delays=settings.delays,
        first_lag=lag,
        last_lag=lag / recordings.length,
        start_share=settings.restart_share,
        restart_share=settings.restart_share,
        settled_share=settings.restart_share,
    )
    with_load = replace(lifting, states=(*lifting.states, LOAD))
    result = identify_estimator(
        name, with_load, tuple(measured), inputs, recordings, batch.sample_period_s, None, estimator
    )
    return result.observer, tuple(np.flatnonzero(at_limit).tolist())


def _visible(batch: EpisodeBatch, load: Array, left_out: int, settings: LoadSettings) -> EpisodeBatch:
    """Recordings with the load as a state, both as far as they can be seen; the conditions are "loaded" and not."""
    loaded = np.any(load != 0, axis=0)
    if not loaded.any() or loaded.all():
        raise DataError(
            f"Load observer: needs recordings with and without load, found {int(loaded.sum())} and "
            f"{int((~loaded).sum())}; {left_out} come to the current's limit; take a smaller load or slower moves."
        )
    dt = batch.sample_period_s
    seen = without_level(low_passed(load, settings.corner_hz, dt), settings.level_s, dt)
    states = np.concatenate([batch.states, seen[..., None]], axis=-1)
    states[..., settings.current] -= load - without_level(load, settings.level_s, dt)
    # Keys of one unit: units with a known load are too few to leave one out.
    keys = tuple(EpisodeKey("", "loaded" if on else "unloaded", str(i)) for i, on in enumerate(loaded))
    return replace(batch, keys=keys, states=states, shown=None, lost=None)
