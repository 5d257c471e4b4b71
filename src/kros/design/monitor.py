"""The monitor of a deployed observer: its bound from what the innovation does on the machines of training.

Of every unit the highest level over its training episodes counts, so that a unit is one draw however long it was recorded; the bound is what one more
unit exceeds with the stated probability (`uncertainty.outliers.tail.prediction_bound`). It holds for units that move as those in training did, for as
long. Where the observer was designed on the same units, new ones have larger innovations by what it learned of those.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..data import EpisodeBatch
from ..data.population import EpisodeKey
from ..evaluate import as_shown
from ..observer import Observer, run_innovations
from ..observer.monitor import Monitor, octaves
from ..uncertainty.outliers.tail import LEAST_SCORES, prediction_bound
from .validation import TrainingSet, spread

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
UNITS, EPISODES, TOGETHER = 60, 3, 60  # most units, most episodes of each in every condition, and episodes in memory
MEMORY = 1000  # samples that mean squares remember
FORGOTTEN = 1e-3  # of a start, when innovations are judged
SETTLE = (100, 1000)
MOVING = 0.1  # of the RMS step of a measurement: less is rest


def fit_monitor(observer: Observer, training: TrainingSet, rate: float) -> Monitor | None:
    """Return the monitor of an observer; None with fewer than three units.

    Parameters
    ----------
    observer : Observer
    training : TrainingSet
        In the observer's units of measure.
    rate : float
        Probability that one more good unit exceeds the bound.

    Returns
    -------
    Monitor or None
    """
    own: dict[tuple[str, str], list[tuple[Array, npt.NDArray[np.bool_], Array]]] = {}
    settle = settling(observer)
    for batch in _batches(training):
        y = batch.measurements(observer.measured)
        nu, judged = run_innovations(observer, y, batch.inputs, observer.own(batch.parameters), settle)
        for i, (key, n) in enumerate(zip(batch.keys, batch.lengths, strict=True)):
            if judged[:n, i].any():
                own.setdefault((key.unit, key.condition), []).append((nu[:n, i], judged[:n, i], y[:n, i]))
    episodes, units = [e for found in own.values() for e in found], list(dict.fromkeys(unit for unit, _ in own))
    if len(units) < LEAST_SCORES:
        log.info("%s has no monitor: its bound needs training episodes of %d units, found %d.", observer.name, LEAST_SCORES, len(units))
        return None
    size = np.sqrt(np.mean([np.mean(np.minimum(nu[judged] ** 2, 1e300), axis=0) for nu, judged, _ in episodes], axis=0))
    if not np.isfinite(size).all() or np.any(size <= 0):
        return None
    filters = octaves()
    free = Monitor(filters, 1 / MEMORY, settle, size, np.ones((len(size), len(filters))), rate, units=len(units))
    peaks: dict[tuple[str, str], float] = {}
    profile, courses = [], []
    for group, of_group in own.items():
        found = [free.mean_squares(nu[:, None], judged[:, None])[:, 0] for nu, judged, _ in of_group]
        levels = [free.level(f) for f in found]
        peaks[group] = max(float(level.max()) for level in levels)
        profile.append(np.log10(np.maximum(np.max([f.max(axis=0) for f in found], axis=0), 1e-30)))
        courses += levels
    conditions = list(dict.fromkeys(condition for _, condition in own))
    bound = float(prediction_bound(np.array([max(peaks.get((u, c), -np.inf) for c in conditions) for u in units]), rate))
    own_peaks = {c: [peaks[u, c] for u in units if (u, c) in peaks] for c in conditions}
    enough = len(conditions) > 1
    bounds = {c: float(prediction_bound(np.array(p), rate)) - bound for c, p in own_peaks.items() if enough and len(p) >= LEAST_SCORES}
    shape = np.mean(profile, axis=0)
    limits = 10 ** (shape - shape.mean() + bound / 10)
    step = np.sqrt(np.nanmean([np.nanmean(np.diff(y, axis=0) ** 2, axis=0) for _, _, y in episodes], axis=0))
    moving = sum(int(np.count_nonzero(j[1:] & (np.abs(np.diff(y, axis=0)) > MOVING * step).any(axis=-1))) for _, j, y in episodes)
    alarms = sum(int(np.count_nonzero(np.diff((level > bound).astype(int)) == 1)) for level in courses)
    return replace(free, limits=limits, bounds=bounds, hours=moving * observer.sample_period_s / 3600, alarms=alarms)


def monitor_facts(monitor: Monitor) -> dict[str, Any]:
    """Return both rates of false alarms: of one more good unit as stated, an hour of motion as counted in training, with its 95 % interval."""
    low, high = poisson_interval(monitor.alarms)
    found = {"false_alarm_rate": monitor.false_alarm_rate, "units": monitor.units, "hours": monitor.hours, "alarms": monitor.alarms}
    per_hour = (None, None) if monitor.hours == 0 else (low / monitor.hours, high / monitor.hours)
    return found | {"alarms_per_hour": per_hour, "settle_samples": monitor.settle}


def poisson_interval(count: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact (Garwood) interval of the mean of a Poisson count."""
    from scipy.stats import chi2

    tail = (1 - level) / 2
    return (float(chi2.ppf(tail, 2 * count) / 2) if count else 0.0), float(chi2.ppf(1 - tail, 2 * count + 2) / 2)


def settling(observer: Observer) -> int:
    """Return the samples in which what the observer began with is forgotten, by the slowest mode of its linear part."""
    n, own, nl = observer.lifting.n_states, observer.controller.n_states, observer.lifting.n_lifted
    step = observer.one_step[:, [*range(n), *range(nl, nl + own)]]
    radius = float(np.abs(np.linalg.eigvals(step)).max(initial=0.0))
    samples = SETTLE[1] if radius >= 1 else np.log(FORGOTTEN) / np.log(max(radius, 1e-9))
    return int(np.clip(np.ceil(samples), *SETTLE)) + observer.runtime.delay


def _batches(training: TrainingSet) -> Iterator[EpisodeBatch]:
    """Read some episodes of some units, as the sensor shows them."""
    groups: dict[tuple[str, str], list[EpisodeKey]] = {}
    for key in training.keys:
        groups.setdefault((key.unit, key.condition), []).append(key)
    units = set(spread(list(dict.fromkeys(unit for unit, _ in groups)), UNITS))
    keys = [key for (unit, _), own in groups.items() if unit in units for key in spread(own, EPISODES)]
    for start in range(0, len(keys), TOGETHER):
        batch = EpisodeBatch.read(training.population, keys[start : start + TOGETHER], None, training.parameters)
        yield as_shown(batch, training.sensor, training.population.states)
