"""Observers over many episodes at once: in the compiled time loop, or step by step in NumPy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..core.arrays import Array, Bits, Flags, Index, Parameters, frozen
from ..loops import Library, formulas, library
from .data import ObserverData
from .monitor import Watch, judged_samples
from .runtime import bounds
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
        Not finite where an input is not known: the last good value stands for it. What is implausible, and where a run
        starts: see `screen`.
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
    return run_observers([observer], y, u, parameters)[0, ..., : len(observer.recorded)]


def run_observers(observers: Sequence[ObserverData], y: Array, u: Array, parameters: Parameters | None = None) -> Array:
    """Run observers of one model side by side, which differ in their corrections: (observer, n_samples, batch, n)."""
    samples = screened(observers[0], y, u)
    courses = [Course(observer, samples.starts.shape[1], parameters) for observer in observers]
    first, *others = [run.estimates[None] for run in _run(courses, samples)]
    return np.concatenate([first, *others]) if others else first  # one may be large: it is not copied


def run_innovations(
    observer: ObserverData, y: Array, u: Array, parameters: Parameters | None = None, settle: int = 0
) -> tuple[Array, Flags]:
    """Return innovations, zero where a measurement is missing, and which samples a monitor judges."""
    samples = screened(observer, y, u)
    (run,) = _run([Course(observer, y.shape[1], parameters)], samples)
    run.starts[0] = True
    return run.innovation, judged_samples(settle, samples.status != 0, run.starts, run.moving)[0]


def _run(courses: Sequence[Course], samples: Screened) -> list[Stepped]:
    """Run observers of one model on: compiled where they go on side by side within their bounds, else in NumPy."""
    loops, alone = library(), len(courses) == 1 or courses[0].steps.gaps is None
    even = alone and all(course.even(samples) for course in courses)
    runs = [None] * len(courses) if loops is None or not even else _compiled(loops, courses, samples)
    finished = [run or stepped(course, samples) for run, course in zip(runs, courses, strict=True)]
    for run, course in zip(finished, courses, strict=True):
        course.observer.runtime.clip_estimate(run.estimates, out=run.estimates)
    return finished


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
        watch: Watch | None = None,  # of one machine
    ) -> None:
        self.watch = watch
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
        for part in (self.loop, self.watch):
            if part is not None:
                part.begin()

    def take(self, y: Array, u: Array) -> Stepped:
        """Run over the next samples, y (n_samples, batch, q) and u (n_samples, batch, m), with the bits of all."""
        samples = screened(self.observer, y, u, self.held)
        (run,) = _run([self], samples)
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
        steps, starts = self.steps, samples.starts[self._before is None :]
        first = self._before is None and not np.isfinite(samples.y[0]).all()
        begun = steps.gaps is None or not (first or steps.gaps.waiting.any())
        far = self.observer.runtime.delay and (self.observer.lifting.history or steps.gaps is not None)
        apart = starts.any() or steps.waiting.any() or self.settling.any() or np.ptp(self.since)
        return begun and not (far or apart or self.loop is not None)

    def enter(self, samples: Screened) -> tuple[Screened, int]:
        """Start at the first sample of all; return samples behind those that inputs are still needed of, a number."""
        if self._before is not None:
            lead = len(self._before.y)
            return samples.after(self._before) if lead else samples, lead
        self.steps.begin(samples.y[0], u=samples.u[0])
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
    taken = moving.copy()
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
        taken[k] = moving[k] & ~steps.waiting
        status[k][steps.waiting | (course.settling > 0)] = SampleStatus.RESTARTED
        course.settling = np.where(steps.waiting, settle, np.maximum(course.settling - 1, 0))
    course.leave(samples)
    status |= _limited(observer, x, steps.x, taken)
    if d:
        _predict(observer, x, earlier, pending, samples, values)
    return Stepped(x[lead:], nu[lead:], status[lead:], starts[lead:], moving[lead:], followed[lead:])


def _limited(observer: ObserverData, x: Array, last: Array, taken: Flags) -> Bits:
    """Return LIMIT where a step that was taken ended at one; states (n_samples, batch, n), and those after the last."""
    x, last = x[1:, :, : len(observer.recorded)], last[None, :, : len(observer.recorded)]
    met = observer.runtime.binds(np.concatenate([x, last]) if len(x) else last)
    return np.where(taken & met, np.uint8(SampleStatus.LIMIT), 0)


def _predict(
    observer: ObserverData, x: Array, earlier: Array, pending: Index, samples: Screened, values: Mapping[str, Array]
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


def _compiled(loops: Library, courses: Sequence[Course], samples: Screened) -> list[Stepped | None]:
    """Run observers of one model on in the compiled loop; those that would leave their bounds stay where they were."""
    (samples, lead), *_ = [course.enter(samples) for course in courses]
    observer, values, since = courses[0].observer, courses[0].values, int(courses[0].since[0])
    (n_samples, batch), delay, lifting = samples.starts.shape, observer.runtime.delay, observer.lifting
    late = np.clip(np.arange(n_samples) - lead + since + 1, 0, delay)  # samples between a state and its row
    first = min(lead + delay - int(late[lead]), n_samples)  # which a measurement corrects
    states = np.empty((n_samples, len(courses), lifting.n_states, batch))
    states[:first] = [course.steps.x.T for course in courses]
    job = _job(courses, samples.rows(slice(first, None)), samples.u[first - delay : n_samples - delay])
    lost = courses[0].steps.gaps is not None and not np.isfinite(samples.y).all()
    of_lifting = formulas(lifting, values, samples.u.shape[2], batch, tuple(observer.measured) if lost else ())
    loops.call("kros_relift", of_lifting, ("relift_job", job | {"states": states[first:]}))
    moving = np.broadcast_to(np.arange(lead, n_samples)[:, None] >= first, (n_samples - lead, batch))
    runs, n, nl = list[Stepped | None](), lifting.n_states, lifting.n_lifted
    for i, course in enumerate(courses):
        if job["left"][i]:
            runs.append(None)
            continue
        x, steps, column = states[:, i].swapaxes(1, 2), course.steps, job["column"][i]
        steps.x, steps.x_c = column[:n].T.copy(), column[nl : nl + steps.x_c.shape[1]].T.copy()
        steps.past, steps.fresh = job["past"][i], steps.fresh & (first == n_samples)
        if steps.gaps is not None:
            steps.gaps.take(job["gap"])
        course.since[:] = late[-1]
        course.leave(samples)
        innovation = np.where(np.isfinite(samples.y), samples.y - x[..., list(observer.measured)], 0.0)
        status = _limited(course.observer, x[lead:], steps.x, moving)
        if delay:
            pending = np.broadcast_to(late[:, None], (n_samples, batch))
            with np.errstate(over="ignore", invalid="ignore"):
                _predict(course.observer, x, np.empty((n_samples, batch, 0)), pending, samples, values)
        runs.append(Stepped(x[lead:], innovation[lead:], status, np.zeros_like(moving), moving, np.empty(0)))
    return runs


def _job(courses: Sequence[Course], samples: Screened, u: Array) -> dict[str, Any]:
    """Return what the compiled loop starts from, with the inputs of the moments at which samples were measured."""
    observer, order = courses[0].observer, max(c.observer.controller.n_states for c in courses)
    (n_samples, batch), (n, nl) = samples.starts.shape, (observer.lifting.n_states, observer.lifting.n_lifted)
    job: dict[str, Any] = {
        "observers": len(courses),
        "samples": n_samples,
        "batch": batch,
        "order": order,
        "q": len(observer.measured),
        "map": np.stack([_padded(c.observer, order) for c in courses]),
        "y": samples.y.swapaxes(1, 2),
        "u": u.swapaxes(1, 2),
        "measured": observer.measured,
        "past": np.stack([c.steps.past for c in courses]),
        "fresh": int(courses[0].steps.fresh.any()),
        "left": np.zeros(len(courses), np.uint8),
    }
    if (gaps := courses[0].steps.gaps) is not None:
        job |= gaps.job
    job["low"], job["high"] = np.swapaxes([bounds(c.observer.guard, n, order) for c in courses], 0, 1)
    job["column"] = np.zeros((len(courses), job["map"].shape[2], batch))
    for column, course in zip(job["column"], courses, strict=True):
        column[:n], column[nl : nl + course.steps.x_c.shape[1]] = course.steps.x.T, course.steps.x_c.T
    return job


def _padded(observer: ObserverData, order: int) -> Array:
    """Return the one-step map with silent controller states up to an order."""
    nl, own = observer.lifting.n_lifted, observer.controller.n_states
    step = np.insert(observer.one_step, [nl + own] * (order - own), 0.0, axis=1)
    return np.pad(step, ((0, order - own), (0, 0)))
