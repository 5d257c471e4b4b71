"""Observers over many episodes at once: in the compiled time loop, or step by step in NumPy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..loops import Library, formulas, library, tape_of
from .data import ObserverData
from .monitor import judged_samples
from .runtime import bounds
from .screen import Bits, Flags, Held, SampleStatus, Screened, Whole, screened
from .step import Parameters, Steps, forward

Array = npt.NDArray[np.float64]
_ROWS = 1000  # samples predicted forward at a time


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
        Not finite where an input is not known: the last good value stands for it. What is implausible, and where a run
        starts: see `screen`.
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
    >>> model = np.array([[0.5]]), np.ones((1, 1)), (0,), ("u",)
    >>> observer = Observer("x", Lifting(("x",)), *model, gain([[0.5]], 0.01), Injection.STATE, 0.01)
    >>> y = np.array([4.0, 8.0, np.nan, 0.0]).reshape(4, 1, 1)  # sample, episode, measurement; one is missing
    >>> run_observer(observer, y, np.zeros((4, 1, 1))).ravel().tolist()
    [4.0, 2.0, 4.0, 2.0]
    """
    return _run([observer], screened(observer, y, u), parameters)[0].estimates


def run_observers(
    observers: Sequence[ObserverData], y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None
) -> Array:
    """Run observers of one model side by side, which differ in their corrections: (observer, n_samples, batch, n)."""
    first = observers[0]
    if len(observers) > 1 and (first.bank is not None or (first.runtime.delay and first.lifting.history)):
        return np.stack([run_observer(o, y, u, parameters) for o in observers])
    return np.stack([run.estimates for run in _run(observers, screened(first, y, u), parameters)])


def run_innovations(
    observer: ObserverData, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None, settle: int = 0
) -> tuple[Array, Flags]:
    """Return innovations, zero where a measurement is missing, and which samples a monitor judges."""
    samples = screened(observer, y, u)
    run = _run([observer], samples, parameters)[0]
    run.starts[0] = True
    return run.innovation, judged_samples(settle, samples.status | run.status, run.starts, run.moving)


def _run(
    observers: Sequence[ObserverData],
    samples: Screened,
    parameters: Parameters | None,
) -> list[Stepped]:
    """Run observers of one model: compiled, and in NumPy again the machines that leave bounds or have gaps to fill."""
    loops, batch = library(), samples.starts.shape[1]
    courses = [Course(o, batch, parameters) for o in observers]
    if loops is None:
        runs = [stepped(course, samples) for course in courses]
    else:
        runs, again = _compiled(loops, courses, samples)
        if observers[0].bank is not None:
            again = again | ~np.isfinite(samples.y).all(axis=(0, 2))
        for run, course, some in zip(runs, courses, again, strict=True):
            if some.any():
                run.replace(np.flatnonzero(some), course, samples)
    for run, observer in zip(runs, observers, strict=True):
        observer.runtime.clip_estimate(run.estimates, out=run.estimates)
    return runs


@dataclass(frozen=True, eq=False)
class Stepped:
    """What an observer did, step by step."""

    estimates: Array  # (n_samples, batch, n)
    innovation: Array  # (n_samples, batch, q)
    status: Bits  # (n_samples, batch): RESTARTED, or nothing
    starts: Flags  # (n_samples, batch)
    moving: Flags  # (n_samples, batch)
    followed: Array  # (n_samples, batch): the parameter that a loop follows

    def replace(self, machines: Whole, course: Course, samples: Screened) -> None:
        """Put what some machines do in NumPy in the place of what they did, from the first sample of all."""
        own = {name: v[machines] for name, v in course.values.items()}
        part = stepped(Course(course.observer, len(machines), own), samples.of(machines))
        for name in ("estimates", "innovation", "status", "starts", "moving"):
            getattr(self, name)[:, machines] = getattr(part, name)


class Course:
    """An observer on its way through blocks of recordings, where a `PhaseLockedLoop` may move a parameter."""

    def __init__(
        self,
        observer: ObserverData,
        batch: int = 1,
        parameters: Parameters | None = None,
        loop: Any = None,
    ) -> None:
        self.values: dict[str, Any] = {k: v + np.zeros(batch) for k, v in observer.values(parameters, (batch,)).items()}
        self.observer, self.loop, self.steps = observer, loop, Steps(observer, batch, self.values)
        self.settling = np.zeros(batch, dtype=int)  # samples until a start has settled
        self.since = np.full(batch, -1, dtype=np.intp)  # samples since a start, at most the delay
        self._before: Screened | None = None  # as many samples as measurements are late

    @property
    def held(self) -> Held | None:
        """What is known of inputs before the next sample."""
        return None if self._before is None else self._before.held

    def ahead(self) -> Array:
        """Return the inputs that no measurement has met yet, (samples, batch, m), of machines that started at once."""
        u = self._before.u if self._before is not None else np.empty((0, 1, 0))
        return u[len(u) - min(len(u), int(self.since[0]) + 1) :]

    def begin(self, first: Screened) -> None:
        """Start all machines at a sample, (1, batch, q), that `take` sees again."""
        self.steps.begin(first.y[0])
        self.settling[:], self.since[:] = 0, -1
        self._before = replace(first.rows(slice(0)), held=Held.nothing(*first.u.shape[1:]))
        if self.loop is not None:
            self.loop.begin()

    def take(self, y: Array, u: Array) -> Stepped:
        """Run over the next samples, y (n_samples, batch, q) and u (n_samples, batch, m), with the bits of all."""
        samples = screened(self.observer, y, u, self.held)
        loops, run = library(), None
        if loops is not None and self.even(samples):
            (run,), restarted = _compiled(loops, [self], samples)
        if run is None or restarted.any():
            run = stepped(self, samples)
        self.observer.runtime.clip_estimate(run.estimates, out=run.estimates)
        return replace(run, status=run.status | samples.status)

    def even(self, samples: Screened) -> bool:
        """Whether the compiled loop can run on: nothing waits, settles, fills a gap or follows."""
        gaps = self.steps.gaps
        lost = gaps is not None and not np.isfinite(samples.y).all()
        filled = gaps is not None and bool(gaps.age.any() or samples.starts[-1].any())
        return self.loop is None and not (lost or filled or self.steps.waiting.any() or self.settling.any())

    def enter(self, samples: Screened) -> tuple[Screened, int]:
        """Start at the first sample of all; return samples behind those that inputs are still needed of, a number."""
        if self._before is not None:
            lead = len(self._before.y)
            return samples.after(self._before) if lead else samples, lead
        self.steps.begin(samples.y[0], u=np.where(samples.starts[0][:, None], samples.u[0], 0.0))
        later = samples.starts.copy()
        later[0] = False
        return replace(samples, starts=later), 0

    def leave(self, samples: Screened) -> None:
        """Hold what the next block needs of the samples that `enter` gave."""
        last = samples.rows(slice(max(0, len(samples.y) - self.observer.runtime.delay), None))
        self._before = replace(last, y=last.y.copy(), u=last.u.copy(), starts=np.zeros_like(last.starts))


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def stepped(course: Course, samples: Screened) -> Stepped:
    """Step an observer, which starts again at the first complete sample after it left its bounds."""
    samples, lead = course.enter(samples)
    (n_samples, batch), observer, loop = samples.starts.shape, course.observer, course.loop
    steps, values, d = course.steps, course.values, observer.runtime.delay
    settle = 0 if observer.guard is None else observer.guard.settle
    x, nu = np.empty((n_samples, batch, observer.lifting.n_states)), np.zeros(samples.y.shape)
    earlier = np.zeros((n_samples, batch, len(observer.lifting.window.earlier)))
    starts, moving, status = samples.starts.copy(), np.zeros(nu.shape[:2], dtype=bool), np.zeros(nu.shape[:2], np.uint8)
    pending, followed = np.zeros((n_samples, batch), dtype=np.intp), np.empty(nu.shape[:2])
    x[:lead] = steps.x
    for k in range(lead, n_samples):
        y, u = samples.y[k], samples.u[k]
        starts[k] |= steps.waiting & samples.complete[k]
        pending[k] = np.minimum(course.since + 1, d)
        course.since = np.where(starts[k], 0, pending[k])
        x[k] = steps.x
        if d:
            earlier[k] = steps.earlier(samples.u[k - pending[k], np.arange(batch)])
        if starts[k].any():
            steps.begin(y, starts[k], u)
            if loop is not None:
                loop.begin(starts[k])
        nu[k] = np.where(np.isfinite(y), steps.innovation(y), 0.0)
        moving[k] = (course.since == d) & ~steps.waiting
        if loop is None:
            steps.step(y, samples.u[max(k - d, 0)], moving[k])
        else:
            followed[k] = values[loop.name]
            values[loop.name] = loop.step(steps, y, u)
        status[k][steps.waiting | (course.settling > 0)] = SampleStatus.RESTARTED
        course.settling = np.where(steps.waiting, settle, np.maximum(course.settling - 1, 0))
    course.leave(samples)
    if d:
        _predict(observer, x, earlier, pending, samples, values)
    return Stepped(x[lead:], nu[lead:], status[lead:], starts[lead:], moving[lead:], followed[lead:])


def _pending(starts: Flags, delay: int, since: npt.ArrayLike = -1) -> Whole:
    """Samples between a state and the row that it is recorded in, (n_samples, batch); `since` before the first."""
    row, first = np.arange(len(starts))[:, None], np.broadcast_to(-1 - np.asarray(since), (1, starts.shape[1]))
    begun = np.maximum.accumulate(np.where(starts, row, first), axis=0)
    return np.minimum(row - np.concatenate([first, begun[:-1]]), delay)


def _predict(
    observer: ObserverData, x: Array, earlier: Array, pending: Whole, samples: Screened, values: Mapping[str, Array]
) -> None:
    """Predict states (n_samples, batch, n) to their rows, without correction."""
    batch = x.shape[1]
    for start in range(0, len(x), _ROWS):
        rows = np.arange(start, min(start + _ROWS, len(x)))
        count, size = pending[rows], len(rows) * batch
        each = {p: np.tile(v, len(rows)) for p, v in values.items()}
        at = rows[:, None] - count + np.arange(observer.runtime.delay)[:, None, None]
        u = samples.u[np.minimum(at, len(samples.u) - 1), np.arange(batch)]
        signals = (part.reshape(*part.shape[:-3], size, part.shape[-1]) for part in (x[rows], earlier[rows], u))
        x[rows] = forward(observer, each, count.ravel(), *signals).reshape(len(rows), batch, -1)


def _compiled(
    loops: Library,
    courses: Sequence[Course],
    samples: Screened,
) -> tuple[list[Stepped], Flags]:
    """Run observers of one model on in the compiled loop; return which machines left bounds, (observer, batch)."""
    (samples, lead), *_ = [course.enter(samples) for course in courses]
    observers, values, delay = [c.observer for c in courses], courses[0].values, courses[0].observer.runtime.delay
    (n_samples, batch), n, m = samples.starts.shape, observers[0].lifting.n_states, samples.u.shape[2]
    late = np.zeros((lead, batch), dtype=np.intp), _pending(samples.starts[lead:], delay, courses[0].since)
    pending, states = np.concatenate(late), np.empty((n_samples, len(observers), n, batch))
    innovation = np.empty(samples.y.shape)  # of the first observer
    job = _job(courses, samples) | _begins(observers, samples, values) | {"states": states, "innovation": innovation}
    before = np.empty((n_samples, batch, job["past"].shape[-1]))
    moving = (pending == delay) & (~samples.starts | (delay == 0))
    if delay:
        job |= {"moving": moving, "before": before, "pending": pending}
    tape = formulas(observers[0].lifting, tape_of(observers[0].lifting, m), values, m, batch)
    loops.call("kros_relift", tape, ("relift_job", job))
    runs, restarted = [], job["restart"].view(bool)
    for i, course in enumerate(courses):
        x = states[:, i].swapaxes(1, 2)
        if not restarted[i].any():
            course.since = np.where(samples.starts[-1], 0, pending[-1])
            _put(course, {name: job[name][i] for name in ("column", "past")}, job["fresh"], x[-1], samples)
        if delay:
            with np.errstate(over="ignore", invalid="ignore"):
                _predict(course.observer, x, before, pending, samples, values)
        status, starts = np.zeros((n_samples - lead, batch), np.uint8), samples.starts[lead:].copy()
        runs.append(Stepped(x[lead:], innovation[lead:], status, starts, moving[lead:].copy(), np.empty(0)))
    return runs, restarted


def _job(courses: Sequence[Course], samples: Screened) -> dict[str, Any]:
    """Return what the compiled loop starts from."""
    observer, order = courses[0].observer, max(c.observer.controller.n_states for c in courses)
    (n_samples, batch), (n, nl) = samples.starts.shape, (observer.lifting.n_states, observer.lifting.n_lifted)
    waiting, restarted = np.zeros((2, len(courses), batch), np.uint8)
    job: dict[str, Any] = {
        "observers": len(courses),
        "samples": n_samples,
        "batch": batch,
        "order": order,
        "q": len(observer.measured),
        "late": observer.runtime.delay,
        "overwrite": int(observer.bank is not None),
        "map": np.stack([_padded(c.observer, order) for c in courses]),
        "y": samples.y.swapaxes(1, 2),
        "u": samples.u.swapaxes(1, 2),
        "measured": observer.measured,
        "past": np.stack([c.steps.past for c in courses]),
        "fresh": courses[0].steps.fresh.astype(np.uint8),
        "waiting": waiting,
        "restart": restarted,
    }
    job["low"], job["high"] = np.swapaxes([bounds(c.observer.guard, n, order) for c in courses], 0, 1)
    job["column"] = np.zeros((len(courses), job["map"].shape[2], batch))
    for column, course in zip(job["column"], courses, strict=True):
        column[:n], column[nl : nl + course.steps.x_c.shape[1]] = course.steps.x.T, course.steps.x_c.T
    return job


def _put(course: Course, left: Mapping[str, Array], fresh: Bits, last: Array, samples: Screened) -> None:
    """Put what the compiled loop left into an observer; `last` is its estimate at the last sample, (batch, n)."""
    steps, n, nl = course.steps, course.observer.lifting.n_states, course.observer.lifting.n_lifted
    steps.x, steps.x_c = left["column"][:n].T.copy(), left["column"][nl : nl + steps.x_c.shape[1]].T.copy()
    steps.past, steps.fresh = left["past"], fresh.view(bool)
    if steps.gaps is not None:
        steps.gaps.offset = steps.gaps.apart(last, samples.y[-1])
    course.leave(samples)


def _begins(observers: Sequence[ObserverData], samples: Screened, values: Mapping[str, Array]) -> dict[str, Any]:
    """Return the estimates of machines that start after the first sample of all, and which they are."""
    rows, machines = np.nonzero(samples.starts)
    if not len(rows):
        return {}
    number = np.zeros(samples.starts.shape, dtype=np.int32)
    number[rows, machines] = 1 + np.arange(len(rows))
    each = {p: v[machines] for p, v in values.items()}
    first = [o.initial(samples.y[rows, machines], each, samples.u[rows, machines]) for o in observers]
    return {"begin": number, "begun": np.stack(first), "begins": len(rows)}


def _padded(observer: ObserverData, order: int) -> Array:
    """Return the one-step map with silent controller states up to an order."""
    nl, own = observer.lifting.n_lifted, observer.controller.n_states
    step = np.insert(observer.one_step, [nl + own] * (order - own), 0.0, axis=1)
    return np.pad(step, ((0, order - own), (0, 0)))
