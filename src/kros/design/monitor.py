"""The monitor of a deployed observer: its bound from what the innovation does on the machines of training.

Of every unit the highest level over its training episodes counts, one after the other as on a machine that does not
stop, so that a unit is one draw however long it was recorded. The bound is what one more unit exceeds with the stated
rate on other motions (`bound_of_peaks`). It holds for units that move as those in training did, for as long. If the
observer was designed on the same units, new ones have larger innovations.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, product

import numpy as np

from ..core import EPS, ITERATED, ROUNDING, Array, Flags, Work, frozen, grouped
from ..observer import Observer, run_innovations, spread
from ..observer.monitor import WEIGHT, Monitor, octaves
from ..observer.sensor_gains import noise_response
from ..uncertainty.outliers.tail import LEAST_SCORES, prediction_bound
from .training import TrainingSet

log = logging.getLogger(__name__)
Group = tuple[str, str]  # unit and condition
Judged = tuple[Array, Flags]  # innovations, (n_samples, q), and which samples are judged


@frozen
class MonitorSettings:
    """How the monitor of the deployed observer is fitted."""

    false_alarm_rate: float = 0.02  # share of good machines that may be reported
    units: int = 60  # at most
    episodes: int = 12  # of a unit in a condition, at most
    memory: int = 8000  # samples that mean squares remember
    beginning: int = 500  # samples that count as quiet in the beginning
    forgotten: float = 1e-3  # share of a start that may be left when innovations are judged
    settle: tuple[int, int] = (100, 1000)  # samples that are not judged after a start, at least and at most
    unjudged: float = 0.25  # share of a training episode, of which no more is not judged
    shrink: float = 0.7  # of covariances to their diagonal
    quietest: float = 0.5  # least variance of a band, share of the median
    motions: int = 6  # of a unit; more of them add nothing to a bound


DEFAULT = MonitorSettings()


def fit_monitor(
    observer: Observer, training: TrainingSet, settings: MonitorSettings = DEFAULT, work: Work | None = None
) -> Monitor | None:
    """Return the monitor of an observer; None with fewer than three units."""
    length, rate = len(training.population.read(training.keys[0])), settings.false_alarm_rate
    settle = min(settling(observer, settings), round(settings.unjudged * length))
    groups = dict(_groups(training, settings))
    runs = (work or Work()).run("monitor", [partial(_judged, observer, part, settle) for part in groups.values()])
    episodes = {group: run for group, run in zip(groups, runs, strict=True) if run}
    units, every = list(dict.fromkeys(unit for unit, _ in episodes)), [e for run in episodes.values() for e in run]
    if len(units) < LEAST_SCORES:
        log.info("%s has no monitor: it needs %d units, found %d.", observer.name, LEAST_SCORES, len(units))
        return None
    largest_square = np.sqrt(np.finfo(float).max)
    squares = [np.minimum(nu[judged] ** 2, largest_square).mean(axis=0) for nu, judged in every]
    size = np.sqrt(np.mean(squares, axis=0))
    if not (np.isfinite(size) & (size > 0)).all():
        return None
    filters = octaves()
    even, forget, first = np.ones((len(size), len(filters))), 1 / settings.memory, 1 / settings.beginning
    free = Monitor(filters, forget, settle, size, even, weighted(even), rate, len(units), first)
    # Mean squares are computed wherever they are needed: all of them would fill a memory.
    in_turn = {group: partial(free.in_turn, run) for group, run in episodes.items()}
    most = {group: np.max([p.max(axis=0) for p in of()], axis=0) for group, of in in_turn.items()}
    largest = {group: 10 * np.log10(np.maximum(values, EPS**2)) for group, values in most.items()}
    weights = weighted(steady(largest, settings))
    peaks = {group: [float(_decibels(p, weights).max()) for p in of()] for group, of in in_turn.items()}
    bound = bound_of_peaks([max((p for (u, _), p in peaks.items() if u == unit), key=max) for unit in units], settings)
    shape = np.mean(list(largest.values()), axis=0)
    limits = 10 ** ((shape - (shape * weights).sum() / WEIGHT + bound) / 10)
    return replace(free, limits=limits, weights=weights)


def _groups(training: TrainingSet, settings: MonitorSettings) -> Iterator[tuple[Group, TrainingSet]]:
    """Take some episodes of some units, by unit and condition."""
    groups = grouped(training.keys, lambda key: (key.unit, key.condition))
    units = spread(list(dict.fromkeys(unit for unit, _ in groups)), settings.units)
    for (unit, condition), keys in groups.items():
        if unit in units:
            some, population = tuple(spread(keys, settings.episodes)), training.population.select([unit], [condition])
            yield (unit, condition), replace(training, keys=some, population=population)


def _judged(observer: Observer, training: TrainingSet, settle: int) -> list[Judged]:
    """Run the observer on episodes as the sensor shows them, and return those in which something is judged."""
    batch = training.read(None)
    y = batch.measurements(observer.measured)
    nu, judged = run_innovations(observer, y, batch.inputs, observer.own(batch.parameters), settle)
    episodes = [(nu[:n, i].copy(), judged[:n, i].copy()) for i, n in enumerate(batch.lengths)]
    return [(values, good) for values, good in episodes if good.any()]


def bound_of_peaks(peaks: Sequence[Sequence[float]], settings: MonitorSettings) -> float:
    r"""Return what the highest level of one more unit, on as many other motions, exceeds with the stated rate, dB."""
    from scipy.special import stdtrit

    rate = settings.false_alarm_rate
    highest, shared = np.array([max(levels) for levels in peaks]), min(map(len, peaks))
    mean, bound = float(highest.mean()), float(prediction_bound(highest, rate))
    if not 1 < shared < settings.motions or bound <= mean:
        return bound
    every = np.array([levels[:shared] for levels in peaks])
    means = {part: every[:, part].max(axis=1).mean() for part in combinations(range(shared), shared // 2)}
    apart = [means[one] - means[other] for one, other in product(means, means) if not {*one} & {*other}]
    wider = stdtrit(shared - 1, 1 - rate) ** 2 - stdtrit(settings.motions - 1, 1 - rate) ** 2
    return mean + float(np.sqrt((bound - mean) ** 2 + wider * np.mean(np.square(apart))))


def steady(largest: Mapping[Group, Array], settings: MonitorSettings) -> Array:
    """Return weights of levels, shape (q, bands), whose mean differs least from unit to unit of a condition."""
    from scipy.optimize import nnls

    by_condition = dict[str, list[Array]]()
    for (_, condition), levels in largest.items():
        by_condition.setdefault(condition, []).append(levels.ravel())
    apart = np.concatenate([np.array(levels) - np.mean(levels, axis=0) for levels in by_condition.values()])
    covariance = apart.T @ apart / max(len(apart) - len(by_condition), 1)
    variance = np.diag(covariance)
    floor = max(settings.quietest * float(np.median(variance)), ROUNDING)
    diagonal = settings.shrink * variance + np.maximum(floor - variance, 0.0)
    covariance = (1 - settings.shrink) * covariance + np.diag(diagonal)
    root, large = np.linalg.cholesky(covariance).T, 1e3 * float(np.sqrt(np.trace(covariance)))
    shares, _ = nnls(np.vstack([root, np.full((1, len(root)), large)]), np.append(np.zeros(len(root)), large))
    return (shares / shares.sum()).reshape(next(iter(largest.values())).shape)


def weighted(shares: Array) -> Array:
    """Return whole numbers that sum to `WEIGHT`, in proportion to shares as nearly as can be."""
    exact = WEIGHT * shares.ravel() / shares.sum()
    whole = np.floor(exact)
    whole[np.argsort(whole - exact, kind="stable")[: WEIGHT - int(whole.sum())]] += 1
    return whole.reshape(shares.shape)


def _decibels(mean_squares: Array, weights: Array) -> Array:
    """Return weighted means of levels, shape (n_samples,), of mean squares (n_samples, q, bands)."""
    used = weights > 0
    return np.log10(np.maximum(mean_squares[:, used], EPS**2)) @ weights[used] * (10 / WEIGHT)


def settling(observer: Observer, settings: MonitorSettings = DEFAULT) -> int:
    """Return the samples in which a start is forgotten, by the slowest mode of a linear part or of a bank's filters."""
    radius = float(noise_response(observer).spectral_radius())
    if observer.bank is not None:
        radius = max(radius, observer.bank.recovery[0])
    samples = settings.settle[1] if radius >= 1 else np.log(settings.forgotten) / np.log(max(radius, ITERATED))
    return int(np.clip(np.ceil(samples), *settings.settle)) + observer.runtime.delay
