"""Recordings as batches of episodes, from arrays."""

import numpy as np

from kros.data import EpisodeBatch
from kros.data.population import EpisodeKey
from kros.observer.simulate import Course
from kros.observer.tracking import PhaseLockedLoop


def batch_of(states, inputs, dt, parameters=None, lengths=None, units=None):
    """Episodes of states and inputs, shape (n_samples, batch, ...); a unit each, and as long as they are, by default."""
    count = states.shape[1]
    names = [str(i) for i in range(count)] if units is None else units
    keys = tuple(EpisodeKey(unit, "", str(i)) for i, unit in enumerate(names))
    lengths = np.full(count, len(states)) if lengths is None else np.asarray(lengths)
    return EpisodeBatch(
        keys, lengths, states, inputs, dt, {name: np.broadcast_to(v, count) for name, v in (parameters or {}).items()}
    )


def run_with_status(observer, y, u, parameters=None):
    """Estimates of a batch with the status bits of every sample."""
    run = Course(observer, y.shape[1], parameters).take(y, u)
    return run.estimates, run.status


def track_parameter(observer, y, u, parameters=None, name="phase", settle_s=None):
    """A batch whose parameter follows the machines: estimates, status and what is `followed`."""
    loop = PhaseLockedLoop(observer, name, y.shape[1], settle_s)
    return Course(observer, y.shape[1], parameters, loop).take(y, u)
