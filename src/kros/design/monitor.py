"""The monitor of a deployed observer: its bound from what the innovation does on the machines of training.

Of every unit the highest level over its training episodes counts, one after the other as on a machine that goes on, so that a unit is one draw however
long it was recorded; the bound is what one more unit exceeds with the stated probability on motions of its own (`bound_of_peaks`). It holds for units
that move as those in training did, for as long. Where the observer was designed on the same units, new ones have larger innovations by what it learned
of those.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.work import Work
from ..data.population import EpisodeKey
from ..observer import Observer
from ..observer.monitor import WEIGHT, Monitor, octaves, poisson_interval
from ..observer.simulate import run_innovations
from ..uncertainty.outliers.tail import LEAST_SCORES, prediction_bound
from .validation import TrainingSet, spread

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
UNITS, EPISODES = 60, 12  # most units, and most episodes of each in every condition
MEMORY, BEGINNING = 8000, 500  # samples that mean squares remember, and that they count as quiet in the beginning
FORGOTTEN = 1e-3  # of a start, when innovations are judged
SETTLE = (100, 1000)
SHRINK, QUIETEST = 0.7, 0.5  # of covariances to their diagonal; of the median variance
MOTIONS = 6  # from which on motions add nothing to a bound
MOVING = 0.1  # of the RMS step of a measurement: less is rest


def fit_monitor(observer: Observer, training: TrainingSet, rate: float, work: Work | None = None) -> Monitor | None:
    """Return the monitor of an observer; None with fewer than three units."""
    tasks = list(_tasks(observer, training, settling(observer)))
    met = (work or Work()).map("monitor", _met, tasks)
    own = {task.group: found for task, found in zip(tasks, met, strict=True) if found}
    episodes, units = [e for found in own.values() for e in found], list(dict.fromkeys(unit for unit, _ in own))
    if len(units) < LEAST_SCORES:
        log.info(
            "%s has no monitor: its bound needs training episodes of %d units, found %d.",
            observer.name,
            LEAST_SCORES,
            len(units),
        )
        return None
    size = np.sqrt(np.mean([e.mean_square() for e in episodes], axis=0))
    if not np.isfinite(size).all() or np.any(size <= 0):
        return None
    filters = octaves()
    even = np.ones((len(size), len(filters)))
    free = Monitor(
        filters, 1 / MEMORY, settling(observer), size, even, weighted(even), rate, units=len(units), first=1 / BEGINNING
    )

    def squares(
        group: tuple[str, str],
    ) -> list[Array]:  # found anew wherever they are needed: all of them fill a memory
        return free.in_turn([(e.innovation, e.judged) for e in own[group]])

    largest = {
        group: 10 * np.log10(np.maximum(np.max([p.max(axis=0) for p in squares(group)], axis=0), 1e-30))
        for group in own
    }
    weights = weighted(steady(largest))
    peaks = {group: [float(_decibels(p, weights).max()) for p in squares(group)] for group in own}
    conditions = list(dict.fromkeys(condition for _, condition in own))
    of = {c: [peaks[u, c] for u in units if (u, c) in peaks] for c in conditions}
    loudest = [max((peaks[u, c] for c in conditions if (u, c) in peaks), key=max) for u in units]
    bound = bound_of_peaks(loudest, rate)
    bounds = {
        c: bound_of_peaks(p, rate) - bound for c, p in of.items() if len(conditions) > 1 and len(p) >= LEAST_SCORES
    }
    shape = np.mean(list(largest.values()), axis=0)
    limits = 10 ** ((shape - (shape * weights).sum() / WEIGHT + bound) / 10)
    step = np.sqrt(np.nanmean([e.step_square() for e in episodes], axis=0))
    moving = sum(e.moving(MOVING * step) for e in episodes)
    alarms = sum(
        _alarms(_decibels(p, weights) > bound) for group in own if max(peaks[group]) > bound for p in squares(group)
    )
    return replace(
        free,
        limits=limits,
        weights=weights,
        bounds=bounds,
        hours=moving * observer.sample_period_s / 3600,
        alarms=alarms,
    )


@dataclass(frozen=True, eq=False)
class _Task:
    """Episodes of a unit in a condition, as an observer meets them."""

    group: tuple[str, str]
    observer: Observer
    training: TrainingSet
    settle: int


@dataclass(frozen=True, eq=False)
class _Met:
    """What an observer met in an episode: innovations and measurements, shape (n_samples, q), and which samples are judged."""

    innovation: Array
    judged: npt.NDArray[np.bool_]
    y: Array

    def mean_square(self) -> Array:
        """Mean square of the innovations that are judged, shape (q,)."""
        return np.asarray(np.mean(np.minimum(self.innovation[self.judged] ** 2, 1e300), axis=0))

    def step_square(self) -> Array:
        """Mean square of the steps of measurements, shape (q,)."""
        return np.asarray(np.nanmean(np.diff(self.y, axis=0) ** 2, axis=0))

    def moving(self, least: Array) -> int:
        """How many samples are judged in which some measurement makes a step of at least a size, shape (q,)."""
        return int(np.count_nonzero(self.judged[1:] & (np.abs(np.diff(self.y, axis=0)) > least).any(axis=-1)))


def _tasks(observer: Observer, training: TrainingSet, settle: int) -> Iterator[_Task]:
    """Take some episodes of some units."""
    groups: dict[tuple[str, str], list[EpisodeKey]] = {}
    for key in training.keys:
        groups.setdefault((key.unit, key.condition), []).append(key)
    units = set(spread(list(dict.fromkeys(unit for unit, _ in groups)), UNITS))
    for (unit, condition), keys in groups.items():
        if unit in units:
            population, chosen = training.population.select([unit], [condition]), tuple(spread(keys, EPISODES))
            own = replace(
                training, population=population, keys=chosen, parameters={unit: training.parameters.get(unit, {})}
            )
            yield _Task((unit, condition), observer, own, settle)


def _met(task: _Task) -> list[_Met]:
    """Run the observer on episodes as the sensor shows them, and return those in which something is judged."""
    observer, batch = task.observer, task.training.read_whole().batch
    y = batch.measurements(observer.measured)
    nu, judged = run_innovations(observer, y, batch.inputs, observer.own(batch.parameters), task.settle)
    every = [_Met(nu[:n, i].copy(), judged[:n, i].copy(), y[:n, i].copy()) for i, n in enumerate(batch.lengths)]
    return [met for met in every if met.judged.any()]


def _alarms(above: npt.NDArray[np.bool_]) -> int:
    return int(np.count_nonzero(above[1:] & ~above[:-1]))


def bound_of_peaks(peaks: Sequence[Sequence[float]], rate: float) -> float:
    r"""Return what the highest level of one more unit, on as many motions of its own, exceeds with probability `rate`, in dB."""
    from scipy.special import stdtrit

    highest, shared = np.array([max(own) for own in peaks]), min(map(len, peaks))
    mean, bound = float(highest.mean()), float(prediction_bound(highest, rate))
    if not 1 < shared < MOTIONS or bound <= mean:
        return bound
    every, half = np.array([own[:shared] for own in peaks]), shared // 2
    means = {part: every[:, part].max(axis=1).mean() for part in combinations(range(shared), half)}
    apart = [
        means[one] - means[other] for one in means for other in combinations(sorted({*range(shared)} - {*one}), half)
    ]
    wider = stdtrit(shared - 1, 1 - rate) ** 2 - stdtrit(MOTIONS - 1, 1 - rate) ** 2
    return mean + float(np.sqrt((bound - mean) ** 2 + wider * np.mean(np.square(apart))))


def steady(largest: Mapping[tuple[str, str], Array]) -> Array:
    """Return weights of levels, shape (q, bands), whose mean differs least from unit to unit of a condition; largest (q, bands)."""
    from scipy.optimize import nnls

    by_condition: dict[str, list[Array]] = {}
    for (_, condition), levels in largest.items():
        by_condition.setdefault(condition, []).append(levels.ravel())
    apart = np.concatenate([np.array(levels) - np.mean(levels, axis=0) for levels in by_condition.values()])
    covariance = apart.T @ apart / max(len(apart) - len(by_condition), 1)
    variance = np.diag(covariance)
    floor = max(QUIETEST * float(np.median(variance)), 1e-12)
    covariance = (1 - SHRINK) * covariance + np.diag(SHRINK * variance + np.maximum(floor - variance, 0.0))
    root, large = np.linalg.cholesky(covariance).T, 1e3 * float(np.sqrt(np.trace(covariance)))
    found, _ = nnls(np.vstack([root, np.full((1, len(root)), large)]), np.append(np.zeros(len(root)), large))
    return np.asarray((found / found.sum()).reshape(next(iter(largest.values())).shape))


def weighted(shares: Array) -> Array:
    """Return whole numbers that sum to `WEIGHT`, in proportion to shares as nearly as can be."""
    exact = WEIGHT * shares.ravel() / shares.sum()
    whole = np.floor(exact)
    whole[np.argsort(whole - exact, kind="stable")[: WEIGHT - int(whole.sum())]] += 1
    return whole.reshape(shares.shape)


def _decibels(mean_squares: Array, weights: Array) -> Array:
    """Weighted means of levels, shape (n_samples,), of mean squares of shape (n_samples, q, bands): band by band, as they lie in memory."""
    level = np.zeros(len(mean_squares))
    for channel, band in np.argwhere(weights > 0):
        level += weights[channel, band] * np.log10(np.maximum(mean_squares[:, channel, band], 1e-30))
    return level * (10 / WEIGHT)


def monitor_facts(monitor: Monitor) -> dict[str, Any]:
    """Return both rates of false alarms: of one more good unit as stated, an hour of motion as counted in training, with its 95 % interval."""
    low, high = poisson_interval(monitor.alarms)
    found = {
        "false_alarm_rate": monitor.false_alarm_rate,
        "units": monitor.units,
        "hours": monitor.hours,
        "alarms": monitor.alarms,
    }
    per_hour = (None, None) if monitor.hours == 0 else (low / monitor.hours, high / monitor.hours)
    return found | {"alarms_per_hour": per_hour, "settle_samples": monitor.settle}


def settling(observer: Observer) -> int:
    """Return the samples in which what the observer began with is forgotten, by the slowest mode of its linear part."""
    n, own, nl = observer.lifting.n_states, observer.controller.n_states, observer.lifting.n_lifted
    step = observer.one_step[:, [*range(n), *range(nl, nl + own)]]
    radius = float(np.abs(np.linalg.eigvals(step)).max(initial=0.0))
    samples = SETTLE[1] if radius >= 1 else np.log(FORGOTTEN) / np.log(max(radius, 1e-9))
    return int(np.clip(np.ceil(samples), *SETTLE)) + observer.runtime.delay
