"""What stands beside the scores of `kros check`: static gains and residual powers of units against the study's, covariates regressed out."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import KrosError
from ...data import Population
from ...data.population import OUTLIERS, EpisodeKey
from ...data.survey import RecordingFacts
from ...design.validation import spread
from ...identify.static_gains import static_gains
from ...observer import Observer
from ...observer.simulate import run_innovations
from ...uncertainty.outliers.quantities import Quantities, QuantityScore, score_quantities
from ...uncertainty.outliers.score import Status
from ..config import StudyConfig
from ..engine.store import Store
from ..stages.read import open_source
from .field import Arriving, arriving
from .recordings import load_calibration

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
Groups = Mapping[tuple[str, str], tuple[EpisodeKey, ...]]
GAINS, POWERS = "static_gains", "residual_power"
_EPISODES = 12  # of every unit and condition, at most
_BLOCKS = 8  # of an episode
_EXPLAINED = 0.5  # of the variance of a state's slow part: of less, its gains say nothing
_GAIN, _POWER_DB = 1e-3, 0.1  # differences that nobody looks at, of the ranges and in dB


@dataclass(frozen=True, eq=False)
class Looked:
    """What is looked at in all recordings alike."""

    observer: Observer
    block: int
    ranges: dict[str, float]
    states: tuple[str, ...]

    @classmethod
    def of(cls, observer: Observer, population: Population, groups: Groups) -> Looked:
        """Take length of blocks and ranges from the study's recordings."""
        episodes = [population.read(keys[0]) for keys in groups.values()]
        block = max(int(np.median([len(e) for e in episodes])) // _BLOCKS, 1)
        size = np.max([np.abs(e).max(axis=0) for e in episodes], axis=0)
        names = [c.name for c in population.channels]
        return cls(observer, block, dict(zip(names, size.tolist(), strict=True)), tuple(s for s in observer.recorded if s in names))

    def quantities(
        self, population: Population, groups: Groups, values: Mapping[str, Mapping[str, float]], condition: str
    ) -> dict[str, Quantities]:
        """Return the quantities of all units in one condition."""
        units = [unit for unit, own in groups if own == condition]
        gains, powers, means = [], [], []
        for unit in units:
            keys = tuple(spread(list(groups[unit, condition]), _EPISODES))
            found = arriving(self.observer, population, keys, {unit: {**self.observer.parameters, **values.get(unit, {})}})
            gains.append(self._gains(population, found))
            powers.append(self._powers(found))
            with np.errstate(invalid="ignore"):
                means.append(np.mean([np.mean(population.read_covariates(key), axis=0) for key in keys], axis=0))
        beside = {c.name: np.array(means)[:, i] for i, c in enumerate(population.covariates)} if units else {}
        names = tuple(f"{s} / {u}" for s in self.states for u in self.observer.inputs)
        floor = np.array([_GAIN * self.ranges[s] / max(self.ranges[u], 1e-300) for s in self.states for u in self.observer.inputs])
        made = {GAINS: _table(units, names, gains, floor, beside)}
        monitor, lifting = self.observer.monitor, self.observer.lifting
        if monitor is not None:
            centres = monitor.centres_hz(self.observer.sample_period_s)
            bands = tuple(f"{lifting.states[i]} {hz:.3g} Hz" for i in self.observer.measured for hz in centres)
            made[POWERS] = _table(units, bands, powers, np.full(len(bands), _POWER_DB), beside)
        return made

    def _gains(self, population: Population, found: Arriving) -> tuple[Array, Array]:
        """Static gains and their deviations, row by row; those of states that inputs do not explain are not known."""
        ranges, batch = np.array([self.ranges[u] for u in self.observer.inputs]), found.batch
        there = [i for i, s in enumerate(self.states) if s in population.states]
        x = batch.states[..., [population.states.index(self.states[i]) for i in there]]
        episodes = list(enumerate(batch.lengths))
        own = static_gains([x[:n, e] for e, n in episodes], [found.u[:n, e] for e, n in episodes], self.block, ranges)
        gains, deviations = np.full((2, len(self.states), len(ranges)), np.nan)
        explained = (own.explained >= _EXPLAINED)[:, None]
        gains[there], deviations[there] = np.where(explained, own.gains, np.nan), np.where(explained, own.deviations, np.nan)
        return gains.ravel(), deviations.ravel()

    def _powers(self, found: Arriving) -> tuple[Array, Array]:
        """Mean power of the innovation in every band, dB, and its deviation from episode to episode."""
        observer, monitor = self.observer, self.observer.monitor
        if monitor is None:
            return np.zeros(0), np.zeros(0)
        nu, judged = run_innovations(
            observer, found.y, found.u, found.parameters(observer, list(range(len(found.batch.keys)))), monitor.settle
        )
        own = []
        for e, n in enumerate(found.batch.lengths):
            if judged[:n, e].any():
                squares = monitor.mean_squares(nu[:n, [e]], judged[:n, [e]])[judged[:n, e], 0]
                own.append(10 * np.log10(np.maximum(squares.mean(axis=0).ravel(), 1e-30)))
        if not own:
            return np.full((2, monitor.limits.size), np.nan)[0], np.zeros(monitor.limits.size)
        return np.mean(own, axis=0), np.std(own, axis=0, ddof=1) / np.sqrt(len(own)) if len(own) > 1 else np.zeros(len(own[0]))


def _table(units: list[str], names: tuple[str, ...], rows: list[tuple[Array, Array]], floor: Array, beside: dict[str, Array]) -> Quantities:
    values, deviations = (np.array([row[i] for row in rows]).reshape(len(rows), len(names)) for i in range(2))
    return Quantities(tuple(units), names, values, deviations, floor, beside)


def scores_beside(
    config: StudyConfig,
    store: Store,
    observer: Observer,
    population: Population,
    values: Mapping[str, Mapping[str, float]],
    known: Mapping[tuple[str, str], Collection[str]],
) -> dict[tuple[str, str], dict[str, dict[str, Any]]]:
    """Return what static gains and residual powers say of every unit and condition of some recordings.

    Parameters
    ----------
    config, store
        Of a finished run.
    observer : Observer
        Its deployed one.
    population : Population
        The recordings.
    values : mapping of unit to mapping of str to float
        Lifting parameters of its units.
    known : mapping of (unit, condition) to collection of str
        Units of the study that each is not compared with, beside that of its own name.

    Returns
    -------
    dict
        By unit and condition: ``static_gains`` and ``residual_power``, each the content of a `QuantityScore`. Empty where the run's recordings are gone.
    """
    facts, calibration = RecordingFacts.load(store.path("population")), load_calibration(store)
    try:
        study = open_source(config)
        own = {} if calibration is None else {u: {calibration.spec.parameter: found.phase_rad} for u, found in calibration.units.items()}
        groups: dict[tuple[str, str], tuple[EpisodeKey, ...]] = {}
        for key in facts.train:
            if facts.groups.get(key.unit) != OUTLIERS and (calibration is None or key.unit in own):
                groups[key.unit, key.condition] = (*groups.get((key.unit, key.condition), ()), key)
        looked = Looked.of(observer, study, groups)
        theirs = {c: looked.quantities(study, groups, own, c) for c in population.conditions}
    except (KrosError, KeyError) as error:
        log.warning("Static gains and residual powers: not compared, since the run's recordings cannot be read: %s", error)
        return {}
    new, found = {(u, c): keys for u, c, keys in population.groups()}, {}
    for condition, quantities in theirs.items():
        mine = looked.quantities(population, new, values, condition)
        for k, unit in enumerate(next(iter(mine.values())).unit_ids):
            without = {unit, *known.get((unit, condition), ())}
            rate = config.uncertainty.false_alarm_rate
            found[unit, condition] = {
                name: score_quantities(quantities[name], table.of([k]), rate, without).content() for name, table in mine.items()
            }
    return found


def with_beside(row: dict[str, Any], beside: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Return a row of `kros check` with what stands beside its score, which flags a unit too; ``outlier_by`` says what did."""
    by = (["monitor" if row.get("score") is None else "model"] if row["outlier"] else []) + [
        n for n, own in beside.items() if own["outlier"]
    ]
    return row | dict(beside) | {"outlier_by": by, "outlier": bool(by), "status": Status.OUTLIER if by else row["status"]}


def beside_lines(row: Mapping[str, Any]) -> list[str]:
    """Return what stands beside a row for people at a terminal."""
    lines = []
    for name in (GAINS, POWERS):
        if name not in row:
            continue
        told, unit = {k: v for k, v in row[name].items() if k != "outlier"}, " dB" if name == POWERS else ""
        own = QuantityScore(**told | {"status": Status(told["status"])})
        title = f"    {name.replace('_', ' ')}  "
        if own.score is None:
            lines.append(f"{title}{Status.CANNOT_TELL.value}: {own.reason}")
            continue
        said = f"{own.status.value.upper() if own.outlier else own.status.value}: {own.quantity} is {own.value:.4g}{unit}, "
        said += f"the other {own.units} say {own.expected:.4g} ± {own.deviation:.2g}{unit}, score {own.score:.2f} (threshold {own.threshold:.2f})"
        said += f", {', '.join(own.covariates)} regressed out" if own.covariates else ""
        lines.append(title + said + (f"; {own.reason}" if own.reason else ""))
    return lines
