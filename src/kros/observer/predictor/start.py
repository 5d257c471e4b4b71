"""The start of an observer in motion, learned from training episodes: maps from the first measurements and inputs to hidden states.

The observer that has run for long knows its states from the past. What it knows at some sample, an observer that starts there should know as soon as it
can: its states are regressed on ``y - M u`` and the inputs that no measurement follows at that sample, then, one after the other, on the innovations of
those that follow (`Start`). That is a Kalman filter's gain in its first samples, with covariances as recorded in place of assumed ones. All
regressors are zero at rest, and so is what they say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...data import EpisodeBatch
from ..observer import Observer
from ..runtime import Runtime
from ..simulate import run_observer
from ..start import Start
from ..step import Steps
from .free_start import in_motion
from .moments import followed_inputs, skipped

Array = npt.NDArray[np.float64]
COUNT = 16  # innovations with gains of their own
_WINDOWS = 2000
_ROUNDS = 3  # an observer that starts better has forgotten its start earlier
_SILENT = 0.05  # of what it says in motion
_STILL = (0.01, 0.05)  # of what machines show in motion: between these is what counts as rest
_RIDGE = 1e-6  # relative to mean squares


def with_start(
    observer: Observer, batch: EpisodeBatch, static: Array | None = None, free: Sequence[int] = (), count: int = COUNT
) -> Observer:
    """Return the observer with a start in motion learned from recordings, if these are long enough for one."""
    at, length = list(observer.measured), int(batch.lengths.min())
    hidden = np.array([i not in at for i in range(observer.lifting.n_states)])
    first, last = skipped(length), length - count - 1
    y, u = batch.measurements(at, arrived=False)[:length], batch.inputs[:length]
    if not hidden.any() or last <= first or not np.isfinite(y).all():
        return observer
    truth = batch.states[:length][..., hidden[: batch.states.shape[-1]]]
    own = {name: np.asarray(values) for name, values in observer.own(batch.parameters).items()}
    if static is None:
        static, free = followed_inputs(u, y, truth)
    seen = np.zeros((len(at) + len(free), len(at) + u.shape[-1]))  # from [y; u] to what is zero at rest
    seen[: len(at)] = np.hstack([np.eye(len(at)), -static])
    seen[range(len(at), len(seen)), [len(at) + j for j in free]] = 1.0
    starts = np.unique(np.linspace(first, last, max(_WINDOWS // y.shape[1], 1)).astype(int))
    window = np.arange(count + 1)[:, None] + starts  # (count + 1, starts)
    y_w, u_w = (values[window].reshape(count + 1, -1, values.shape[-1]) for values in (y, u))
    repeated = {name: np.tile(values, len(starts)) for name, values in own.items()}
    alone = replace(observer, runtime=Runtime(), start_in_motion=None)
    rest = alone.initial(y_w[0], repeated)
    moving = np.concatenate([y_w[0], u_w[0]], axis=-1) @ seen.T
    start, still = None, at_rest(seen, moving, np.concatenate([y[0], u[0]], axis=-1) @ seen.T, in_motion(truth))
    for _ in range(_ROUNDS):
        known = run_observer(replace(alone, start_in_motion=start), y, u, own)[window].reshape(
            count + 1, -1, len(hidden)
        )
        gain = regressed(moving, np.where(hidden, known[0] - rest, 0.0)) @ seen
        if not shows_motion(gain @ np.concatenate([y[0], u[0]], axis=-1).T, (known[0] - rest).T, truth):
            gain, still = np.zeros_like(gain), still[:0]
        start = Start(gain, np.zeros((0, len(hidden), len(at))), still)
        steps = Steps([replace(alone, start_in_motion=start)], len(rest), {**alone.parameters, **repeated})
        steps.begin(y_w[0], u=u_w[0])
        corrections = np.zeros((count, len(hidden), len(at)))
        for k in range(count):
            innovation = steps.innovation(y_w[k])[0]
            steps.step(y_w[k], u_w[k])
            corrections[k] = regressed(innovation, np.where(hidden, known[k + 1] - steps.x[0], 0.0))
            steps.near[0] += innovation @ corrections[k].T
        start = Start(gain, corrections, still)
    return replace(observer, start_in_motion=start)


def at_rest(seen: Array, moving: Array, first: Array, begun: bool) -> Array:
    """Return rows of `Start.rest`: three times what machines show that rest at first, within shares of what they show in motion; those that say nothing go."""
    size = np.sqrt(np.mean(moving**2, axis=0))
    bound = _STILL[0] * size if begun else np.clip(3 * np.abs(first).max(axis=0), _STILL[0] * size, _STILL[1] * size)
    return seen[size > 0] / bound[size > 0, None]


def shows_motion(said: Array, known: Array, truth: Array) -> bool:
    """Whether the first sample tells a machine in motion from one at rest: where recordings start at rest, it says nothing there."""
    if in_motion(truth):
        return True
    size = np.sqrt(np.mean(known**2, axis=1))
    share = np.sqrt(np.mean(said**2, axis=1)) / np.where(size > 0, size, np.inf)
    return bool(share.max() <= _SILENT)


def regressed(seen: Array, missed: Array) -> Array:
    """Return the linear map from what is seen, shape (rows, k), to what is missed, shape (rows, n); shape (n, k)."""
    size = np.sqrt(np.mean(seen**2, axis=0))
    scaled = seen / np.where(size > 0, size, 1.0)
    moments = scaled.T @ scaled / len(scaled) + _RIDGE * np.eye(seen.shape[1])
    found = np.linalg.solve(moments, scaled.T @ missed / len(scaled)).T
    return np.asarray(np.divide(found, size, out=np.zeros_like(found), where=size > 0))
