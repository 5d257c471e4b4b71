"""Observers over many episodes at once: in the compiled time loop, or step by step in NumPy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..core.arrays import Array, Bits, Flags, Index, Parameters, frozen
from ..loops import Library, formulas, library
from .data import ObserverData
from .monitor import Watch, judged_samples
from .screen import Held, SampleStatus, Screened, screened
from .step import Steps, forward

_ROWS = 1000  # samples predicted forward at a time


def run_observer(
    observer: ObserverData,
    y: Array,
    u: Array,
    parameters: Parameters | None = None,
) -> Array:
    """Run an observer over a batch of episodes.

    Parameters
    ----------
    observer : ObserverData
    y : ndarray, shape (n_samples, batch, q)
        Row k is what arrives at k; NaN or infinite where a measurement is missing, which then corrects nothing.
    u : ndarray, shape (n_samples, batch, m)
        Not finite where an input is not known: its last good value and change stand for it. What is implausible, and
        where a run starts: see `screen`.
    parameters : mapping of str to array_like, shape (batch,)
        Lifting parameters of the machine behind each episode; the observer's own where absent.

    Returns
    -------
    ndarray, shape (n_samples, batch, n)
        Row k is the estimate of the recorded states at k from what arrived up to k - 1; row 0 is the start.

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
    >>> model = np.array([[0.5]]), np.ones((1, 1)), (0,), ("u",)
    >>> observer = Observer("x", Lifting(("x",)), *model, gain([[0.5]], 0.01), Injection.STATE, 0.01)
    >>> y = np.array([4.0, 8.0, np.nan, 0.0]).reshape(4, 1, 1)  # sample, episode, measurement; one is missing
    >>> run_observer(observer, y, np.zeros((4, 1, 1))).ravel().tolist()
    [4.0, 2.0, 4.0, 2.0]
    """
    return next(run_observers([observer], y, u, parameters))[..., : len(observer.recorded)]


def run_observers(
    observers: Sequence[ObserverData], y: Array, u: Array, parameters: Parameters | None = None
) -> Iterator[Array]:
    """Yield the estimates (n_samples, batch, n) of observers that see the same samples."""
    samples = screened(observers[0], y, u)
    for observer in observers:
        yield _run(Course(observer, y.shape[1], parameters), samples).estimates


def run_innovations(
    observer: ObserverData, y: Array, u: Array, parameters: Parameters | None = None, settle: int = 0
) -> tuple[Array, Flags]:
    """Return innovations, zero where a measurement is missing, and which samples a monitor judges."""
    samples = screened(observer, y, u)
    run = _run(Course(observer, y.shape[1], parameters), samples)
    run.starts[0] = True
    return run.innovation, judged_samples(settle, samples.status != 0, run.starts, run.moving)[0]


def _run(course: Course, samples: Screened) -> Stepped:
    """Run an observer on: compiled where machines go on side by side within their bounds, else in NumPy."""
    loops = library()
    if course.held is None:
        course.steps.begin(samples.y[0], u=samples.u[0])
        samples.starts[0] = False  # it has started
    run = _compiled(loops, course, samples) if loops is not None and course.even(samples) else None
    return stepped(course, samples) if run is None else run


@frozen
class Stepped:
    """What an observer did, step by step."""

    estimates: Array  # (n_samples, batch, n)
    innovation: Array  # (n_samples, batch, q)
    status: Bits  # (n_samples, batch): RESTARTED, and LIMIT where the step ended at one
    starts: Flags  # (n_samples, batch)
    moving: Flags  # (n_samples, batch)
    followed: Array  # (n_samples, batch): the parameter that a loop follows


class Course:
    """An observer on its way through blocks of recordings, where a `PhaseLockedLoop` may move a parameter."""

    def __init__(
        self,
        observer: ObserverData,
        batch: int = 1,
        parameters: Parameters | None = None,
        loop: Any = None,
        watched: bool = False,  # by its monitor: one machine
    ) -> None:
        self.watch = Watch(observer.monitor) if watched and observer.monitor is not None else None
        self.values: dict[str, Any] = {k: v + np.zeros(batch) for k, v in observer.values(parameters, (batch,)).items()}
        self.observer, self.loop, self.steps = observer, loop, Steps(observer, batch, self.values)
        self.settling = np.zeros(batch, dtype=int)  # samples until a start has settled
        self.since = np.full(batch, -1, dtype=np.intp)  # samples since a start, at most the delay
        self.held: Held | None = None  # before the first sample
        # of the last samples, as many as measurements are late
        self.inputs = np.empty((0, batch, len(observer.inputs)))

    def ahead(self) -> Array:
        """Return the inputs that no measurement has met yet, (samples, batch, m), of machines that started at once."""
        return self.inputs[-int(self.since[0]) - 1 :]

    def begin(self, first: Screened) -> None:
        """Start all machines at a sample, (1, batch, q), that `take` sees again."""
        self.steps.begin(first.y[0])
        self.settling[:], self.since[:] = 0, -1
        self.held, self.inputs = Held.nothing(*first.u.shape[1:]), first.u[:0]
        for part in (self.loop, self.watch):
            if part is not None:
                part.begin()

    def take(self, y: Array, u: Array) -> Stepped:
        """Run over the next samples, y (n_samples, batch, q) and u (n_samples, batch, m), with the bits of all."""
        samples = screened(self.observer, y, u, self.held)
        run = _run(self, samples)
        return replace(run, status=self.bits(samples, run))

    def bits(self, samples: Screened, run: Stepped) -> Bits:
        """Return the status of samples, of a machine that is watched too."""
        if self.watch is None:
            return samples.status | run.status
        flags = (samples.status != 0, run.starts, run.moving)
        outside = self.watch.take(run.innovation[:, 0], *(of[:, 0] for of in flags))
        return samples.status | run.status | np.where(outside, np.uint8(SampleStatus.UNCERTIFIED), 0)[:, None]

    def even(self, samples: Screened) -> bool:
        """Whether machines go on side by side: none starts again, settles, follows or looks far back."""
        steps = self.steps
        far = self.observer.runtime.delay and (self.observer.lifting.history or steps.gaps is not None)
        apart = samples.starts.any() or self.settling.any() or np.ptp(self.since)
        return not (far or steps.waiting.any() or apart or self.loop is not None)

    def with_past(self, u: Array) -> Array:
        """Return inputs behind those of the last samples."""
        return np.concatenate([self.inputs, u]) if len(self.inputs) else u


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def stepped(course: Course, samples: Screened) -> Stepped:
    """Step an observer, which starts again at the first complete sample after it left its bounds."""
    (n_samples, batch), observer, loop = samples.starts.shape, course.observer, course.loop
    steps, values, d = course.steps, course.values, observer.runtime.delay
    u, before = course.with_past(samples.u), len(course.inputs)
    settle = 0 if observer.guard is None else observer.guard.settle
    x, nu = np.empty((n_samples, batch, observer.lifting.n_states)), np.zeros(samples.y.shape)
    earlier = np.zeros((n_samples, batch, len(observer.lifting.window.earlier)))
    starts, moving, status = samples.starts.copy(), np.zeros(nu.shape[:2], dtype=bool), np.zeros(nu.shape[:2], np.uint8)
    pending, followed = np.zeros((n_samples, batch), dtype=np.intp), np.empty(nu.shape[:2])
    taken = moving.copy()
    for k, y in enumerate(samples.y):
        starts[k] |= steps.waiting & samples.complete[k]
        pending[k] = np.minimum(course.since + 1, d)
        course.since = np.where(starts[k], 0, pending[k])
        x[k] = steps.x
        if d:
            earlier[k] = steps.earlier(u[before + k - pending[k], np.arange(batch)])
        if starts[k].any():
            steps.begin(y, starts[k], samples.u[k])
            if loop is not None:
                loop.begin(starts[k])
        if steps.gaps is not None:
            steps.gaps.believed[samples.unsure[k]] = 0.0
        nu[k] = np.where(np.isfinite(y), steps.innovation(y), 0.0)
        moving[k] = (course.since == d) & ~steps.waiting
        if loop is None:
            steps.step(y, u[max(before + k - d, 0)], moving[k])
        else:
            followed[k] = values[loop.name]
            values[loop.name] = loop.step(steps, y, samples.u[k])
        taken[k] = moving[k] & ~steps.waiting
        status[k][steps.refused] = SampleStatus.LIMIT
        status[k][steps.waiting | (course.settling > 0)] |= np.uint8(SampleStatus.RESTARTED)
        course.settling = np.where(steps.waiting, settle, np.maximum(course.settling - 1, 0))
    return _finished(course, samples, Stepped(x, nu, status, starts, moving, followed), earlier, pending, taken)


def _compiled(loops: Library, course: Course, samples: Screened) -> Stepped | None:
    """Run an observer on in the compiled loop; None where a machine would leave its bounds: all stay."""
    observer, steps, u, q = course.observer, course.steps, course.with_past(samples.u), list(course.observer.measured)
    (n_samples, batch), d = samples.starts.shape, observer.runtime.delay
    late = np.clip(np.arange(n_samples) + int(course.since[0]) + 1, 0, d)  # samples between a state and its row
    first = min(d - int(late[0]), n_samples)  # which a measurement corrects
    begin, states = len(course.inputs) + first - d, np.empty((n_samples, steps.x.shape[1], batch))
    states[:first] = steps.x.T
    entries, y = () if steps.gaps is None else observer.measured, samples.y[first:].swapaxes(1, 2).copy()
    of_lifting = formulas(observer.lifting, course.values, u.shape[2], batch, entries)
    job = steps.job | {"samples": n_samples - first, "batch": batch, "states": states[first:]}
    job |= {"unsure": samples.unsure[first:].view(np.uint8)} if entries else {}
    job |= {"y": y, "u": u[begin : begin + n_samples - first].swapaxes(1, 2)}
    loops.call("kros_relift", of_lifting, ("relift_job", job))
    if job["left"]:
        return None
    if first < n_samples:
        steps.take(job)
    course.since[:] = late[-1]
    x, still = states.swapaxes(1, 2), np.zeros((n_samples, batch), dtype=bool)
    innovation = np.where(np.isfinite(samples.y), samples.y - x[..., q], 0.0)
    moving = np.broadcast_to(np.arange(n_samples)[:, None] >= first, still.shape)
    status, refused = still.astype(np.uint8), (np.isnan(y) & np.isfinite(samples.y[first:].swapaxes(1, 2))).any(axis=1)
    status[first:][refused] = SampleStatus.LIMIT
    run = Stepped(x, innovation, status, still, moving, np.empty(0))
    pending = np.broadcast_to(late[:, None], still.shape)
    return _finished(course, samples, run, np.empty((n_samples, batch, 0)), pending, moving)


@np.errstate(over="ignore", invalid="ignore")
def _finished(course: Course, samples: Screened, run: Stepped, earlier: Array, pending: Index, taken: Flags) -> Stepped:
    """Predict states to their rows and limits; the status is LIMIT where a step that was taken ended at one."""
    runtime, n = course.observer.runtime, len(course.observer.recorded)
    u, x = course.with_past(samples.u), run.estimates
    met = [runtime.binds(states[..., :n]) for states in (x[1:], course.steps.x[None])]
    run.status[taken & np.concatenate(met)] |= np.uint8(SampleStatus.LIMIT)
    if runtime.delay:
        _predict(course, x, earlier, pending, u)
    runtime.clip_estimate(x)
    course.held, course.inputs = samples.held, u[max(0, len(u) - runtime.delay) :].copy()
    return run


def _predict(course: Course, x: Array, earlier: Array, pending: Index, u: Array) -> None:
    """Predict states (n_samples, batch, n) to their rows over inputs, those of the last samples first."""
    batch, d = x.shape[1], course.observer.runtime.delay
    for start in range(0, len(x), _ROWS):
        rows = np.arange(start, min(start + _ROWS, len(x)))
        count, size = pending[rows], len(rows) * batch
        each = {p: np.tile(v, len(rows)) for p, v in course.values.items()}
        at = len(course.inputs) + rows[:, None] - count + np.arange(d)[:, None, None]
        inputs = u[np.minimum(at, len(u) - 1), np.arange(batch)]
        signals = (part.reshape(*part.shape[:-3], size, part.shape[-1]) for part in (x[rows], earlier[rows], inputs))
        x[rows] = forward(course.observer, each, count.ravel(), *signals).reshape(len(rows), batch, -1)
