"""Observers over many episodes at once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from ..loops import library
from .data import ObserverData
from .guard import Restarts
from .monitor import judged_samples
from .samples import Bits, Flags, SampleStatus, Screened, Whole
from .screen import Screen, screened
from .step import Parameters, Steps

Array = npt.NDArray[np.float64]
_ROWS = 512  # samples predicted forward at a time


def run_observer(
    observer: ObserverData,
    y: Array,
    u: Array,
    parameters: Mapping[str, npt.ArrayLike] | None = None,
) -> Array:
    """Run an observer over a batch of episodes.

    Parameters
    ----------
    observer : ObserverData
    y : ndarray, shape (n_samples, batch, q)
        Row k is what arrives at k; NaN or infinite where a measurement is missing, which then corrects nothing.
    u : ndarray, shape (n_samples, batch, m)
        Not finite where an input is not known: the last good value stands for it. What is implausible, and where a run starts: see `screen`.
    parameters : mapping of str to array_like, shape (batch,)
        Lifting parameters of the machine behind each episode; the observer's own where absent.

    Returns
    -------
    ndarray, shape (n_samples, batch, n)
        Row k is the estimate of the state at k from what arrived up to k - 1; row 0 is the start.

    Raises
    ------
    DimensionError
        When measurements and inputs do not fit to each other or to the observer.
    ConfigError
        When a parameter is unknown, missing or not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import gain
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer, run_observer
    >>> from kros.synthesis import Injection
    >>> observer = Observer("x", Lifting(("x",)), np.array([[0.5]]), np.ones((1, 1)), (0,), ("u",), gain([[0.5]], 0.01), Injection.STATE, 0.01)
    >>> y = np.array([4.0, 8.0, np.nan, 0.0]).reshape(4, 1, 1)  # sample, episode, measurement; one is missing
    >>> run_observer(observer, y, np.zeros((4, 1, 1))).ravel().tolist()
    [4.0, 2.0, 4.0, 2.0]
    """
    return _run([observer], screened(observer, y, u), parameters)[0]


def run_with_status(
    observer: ObserverData, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None
) -> tuple[Array, Bits]:
    """Run an observer as `run_observer` does, and return the bits of `SampleStatus` of every sample too, shape (n_samples, batch).

    Bits that samples have by themselves, and `RESTARTED`.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import gain
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Guard, Observer, run_with_status
    >>> from kros.synthesis import Injection
    >>> guard = Guard(np.array([-9.0]), np.array([9.0]), np.zeros(0), settle=1)
    >>> unstable = np.array([[2.0]]), np.zeros((1, 0)), (0,), (), gain([[2.0]], 0.01), Injection.STATE, 0.01
    >>> observer = Observer("x", Lifting(("x",)), *unstable, guard=guard)
    >>> y = np.array([1.0, np.nan, np.nan, np.nan, 1.0, 1.0]).reshape(6, 1, 1)
    >>> estimate, status = run_with_status(observer, y, np.zeros((6, 1, 0)))
    >>> estimate.ravel().tolist(), status.ravel().tolist()  # 16 would be too large: it waits for the next measurement
    ([1.0, 2.0, 4.0, 8.0, 8.0, 2.0], [0, 1, 1, 17, 16, 0])
    """
    samples, status = screened(observer, y, u), np.zeros(np.shape(y)[:2], np.uint8)
    found = _run([observer], samples, parameters, status)[0]
    return found, samples.status | status


def run_observers(
    observers: Sequence[ObserverData], y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None
) -> Array:
    """Run observers of one and the same model, which differ in their corrections, side by side.

    Parameters
    ----------
    observers : sequence of ObserverData
        Of the same lifting, measured states and inputs; corrections may have different orders.
    y, u, parameters
        As in `run_observer`.

    Returns
    -------
    ndarray, shape (observer, n_samples, batch, n)
        A view with the samples outermost in memory.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import gain
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer, run_observers
    >>> from kros.synthesis import Injection
    >>> plant = Lifting(("x",)), np.array([[0.5]]), np.ones((1, 1)), (0,), ("u",)
    >>> observers = [Observer(f"gain {L}", *plant, gain([[L]], 0.01), Injection.STATE, 0.01) for L in (0.0, 0.5)]
    >>> run_observers(observers, np.array([4.0, 8.0, 0.0]).reshape(3, 1, 1), np.zeros((3, 1, 1))).reshape(2, 3).tolist()
    [[4.0, 2.0, 1.0], [4.0, 2.0, 4.0]]
    """
    (found,) = run_some_at_a_time(observers, y, u, parameters, len(observers))
    return found


def run_some_at_a_time(
    observers: Sequence[ObserverData], y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None, count: int
) -> Iterator[Array]:
    """Yield what `run_observers` returns, so many observers at a time: estimates of all of them may fill a memory."""
    first = observers[0]
    if any((o.lifting, o.measured, o.inputs) != (first.lifting, first.measured, first.inputs) for o in observers[1:]):
        raise DimensionError(
            f"Running {len(observers)} observers side by side: they differ in lifting, measured states or inputs; run them one by one."
        )
    late = first.runtime.delay
    alone = any(
        o.bank is not None
        or o.runtime.delay != late
        or not o.runtime.clips_alike(first.runtime)
        or not Screen.of(o).same_as(Screen.of(first))
        for o in observers
    )
    alone |= bool(late and first.lifting.history)
    samples = None if alone else screened(first, y, u)
    for start in range(0, len(observers), count):
        some = observers[start : start + count]
        if samples is None:
            each = [_run([o], screened(o, y, u), parameters)[0] for o in some]
            yield np.stack(each) if len(each) > 1 else each[0][None]
        else:
            yield _run(some, samples, parameters)


def _run(
    observers: Sequence[ObserverData], samples: Screened, parameters: Parameters | None, status: Bits | None = None
) -> Array:
    """Run observers on screened samples, shape (observer, n_samples, batch, n); bits of those that start again go into `status`."""
    if len(observers) > 1 and library() is None:
        return np.concatenate([_run([o], samples, parameters) for o in observers])
    if observers[0].bank is not None and (gaps := _with_gaps(samples)) is not None:
        return _run_apart(observers, samples, parameters, status, gaps)
    observer, d = observers[0], observers[0].runtime.delay
    (n_samples, batch), values = samples.starts.shape, observer.values(parameters, samples.starts.shape[1:])
    steps, pending = Steps(observers, batch, values), _pending(samples.starts, d) if d else None
    moving = None if pending is None else (pending == d) & ~samples.starts
    estimates = np.empty((n_samples, len(observers), observer.lifting.n_states, batch))
    before = None if pending is None else (np.empty((n_samples, batch, len(observer.lifting.window.earlier))), pending)
    steps.begin(samples.y[0])
    steps.begin(samples.y[0], samples.starts[0], samples.u[0])
    steps.through(samples.y, samples.u, d, moving, samples.starts, estimates, before=before)
    found = estimates.transpose(1, 0, 3, 2)
    with np.errstate(over="ignore", invalid="ignore"):
        if before is not None:
            for own, of_one in zip(observers, found, strict=True):
                _predict(own, of_one, *before, samples, values)
        for i, machines in enumerate(np.flatnonzero(own) for own in steps.restart):
            if len(machines):
                again = _restarting(
                    observers[i], samples.of(machines), observers[i].values(_values_of(values, machines))
                )
                found[i][:, machines] = again.estimates
                if status is not None:
                    status[:, machines] = again.status
        if observer.runtime.binding:
            observer.runtime.clip_estimates(found)
    return found


def _with_gaps(samples: Screened) -> Whole | None:
    """Return the machines of which a measurement is missing, where there are others too; None where the compiled loop takes all or none."""
    gaps = ~np.isfinite(samples.y).all(axis=(0, 2))
    return np.flatnonzero(gaps) if gaps.any() and not gaps.all() else None


def _run_apart(
    observers: Sequence[ObserverData],
    samples: Screened,
    parameters: Parameters | None,
    status: Bits | None,
    gaps: Whole,
) -> Array:
    """Run machines with gaps and those without one after the other."""
    values, batch = observers[0].values(parameters, samples.starts.shape[1:]), samples.starts.shape[1]
    found = np.empty((len(observers), *samples.y.shape[:2], observers[0].lifting.n_states))
    for machines in (gaps, np.setdiff1d(np.arange(batch), gaps)):
        own = None if status is None else status[:, machines].copy()
        found[:, :, machines] = _run(observers, samples.of(machines), _values_of(values, machines), own)
        if status is not None and own is not None:
            status[:, machines] = own
    return found


def _values_of(values: Parameters, machines: Whole) -> dict[str, npt.ArrayLike]:
    """Return the parameters of some machines."""
    return {name: value if np.size(value) == 1 else np.asarray(value)[machines] for name, value in values.items()}


@dataclass(frozen=True, eq=False)
class _Restarting:
    """What an observer does on machines on which its guard starts it again."""

    estimates: Array  # (n_samples, batch, n)
    innovation: Array  # (n_samples, batch, q)
    status: Bits  # (n_samples, batch)
    starts: Flags  # (n_samples, batch)
    moving: Flags  # (n_samples, batch)


def _restarting(observer: ObserverData, samples: Screened, values: Parameters) -> _Restarting:
    """Step an observer, which starts again at the first complete sample after it left its bounds."""
    (n_samples, batch), d = samples.starts.shape, observer.runtime.delay
    steps, restarts = Steps([observer], batch, values), Restarts(observer.guard, batch)
    x, nu = np.empty((n_samples, batch, observer.lifting.n_states)), np.zeros(samples.y.shape)
    earlier, pending = (
        np.empty((n_samples, batch, len(observer.lifting.window.earlier))),
        np.zeros((n_samples, batch), dtype=np.intp),
    )
    starts, moving, status = (
        samples.starts.copy(),
        np.zeros((n_samples, batch), dtype=bool),
        np.zeros((n_samples, batch), np.uint8),
    )
    since, missing = np.zeros(batch, dtype=np.intp), ~np.isfinite(samples.y)
    steps.begin(samples.y[0])
    steps.begin(samples.y[0], starts[0], samples.u[0])
    for k in range(n_samples):
        if k:
            starts[k] |= steps.waiting[0] & samples.complete[k]
            pending[k] = np.minimum(since + 1, d)
            since = np.where(starts[k], 0, pending[k])
        x[k], earlier[k] = steps.x[0], steps.earlier(samples.u[k - pending[k], np.arange(batch)])[0]
        if k and starts[k].any():
            steps.begin(samples.y[k], starts[k], samples.u[k])
        nu[k] = steps.innovation(samples.y[k])[0]
        moving[k] = (since == d) & ~steps.waiting[0]
        steps.step(samples.y[k], samples.u[max(k - d, 0)], missing[k], moving[k])
        status[k][restarts.after(steps.waiting[0])] = SampleStatus.RESTARTED
    if d:
        _predict(observer, x, earlier, pending, samples, values)
    return _Restarting(x, nu, status, starts, moving)


def run_innovations(
    observer: ObserverData, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None, settle: int = 0
) -> tuple[Array, Flags]:
    """Return innovations as an observer meets them, and which samples a monitor judges."""
    samples, values = screened(observer, y, u), observer.values(parameters, np.shape(y)[1:2])
    (n_samples, batch), d = samples.starts.shape, observer.runtime.delay
    steps, innovation = Steps([observer], batch, values), np.zeros(samples.y.shape)
    moving = (_pending(samples.starts, d) == d) & ~samples.starts if d else np.ones((n_samples, batch), dtype=bool)
    steps.begin(samples.y[0])
    steps.begin(samples.y[0], samples.starts[0], samples.u[0])
    steps.through(samples.y, samples.u, d, moving if d else None, samples.starts, innovation=innovation)
    starts, status = samples.starts.copy(), samples.status
    machines = np.flatnonzero(steps.restart[0])
    if len(machines):
        with np.errstate(over="ignore", invalid="ignore"):
            again = _restarting(observer, samples.of(machines), observer.values(_values_of(values, machines)))
        moving, status = moving.copy(), status.copy()
        innovation[:, machines], starts[:, machines], moving[:, machines] = again.innovation, again.starts, again.moving
        status[:, machines] |= again.status
    starts[0] = True
    return innovation, judged_samples(settle, status, starts, moving)


def _pending(starts: Flags, delay: int) -> Whole:
    """Samples between a state and the row that it is recorded in, shape (n_samples, batch)."""
    row = np.arange(len(starts))[:, None]
    begun = np.maximum.accumulate(np.where(starts, row, 0), axis=0)
    since = row - np.concatenate([begun[:1] * 0, begun[:-1]])
    return np.minimum(since, delay)


def _predict(
    observer: ObserverData, x: Array, earlier: Array, pending: Whole, samples: Screened, values: Parameters
) -> None:
    """Take states, shape (n_samples, batch, n), over the samples that lie between them and their rows, without correction."""
    batch, machines = x.shape[1], np.arange(x.shape[1])
    for start in range(0, len(x), _ROWS):
        rows = slice(start, min(start + _ROWS, len(x)))
        count, ahead = pending[rows], x[rows]
        own = {
            name: np.tile(np.broadcast_to(np.asarray(v, dtype=float), (batch,)), len(count))
            for name, v in values.items()
        }
        steps = Steps([observer], count.size, own)
        steps.place(ahead.reshape(count.size, -1), earlier[rows].reshape(count.size, -1))
        j = np.arange(observer.runtime.delay)[:, None, None]
        at = np.minimum(np.arange(rows.start, rows.stop)[:, None] - count + j, len(samples.u) - 1)
        u = samples.u[at, machines]
        steps.through(None, u.reshape(len(j), count.size, u.shape[-1]), moving=(j < count).reshape(len(j), -1))
        x[rows] = steps.x[0].reshape(ahead.shape)
