"""Static gains and residual powers of units: what a distance of models hardly sees, measured alike in the recordings of a study and in new ones.

training episodes --deployed observer--> UnitQuantities, kept with the run --`kros check`--> new units against them
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..core.artifacts import load_artifact, save_artifact
from ..core.loading import check_shapes, loader
from ..core.work import Work
from ..data import Population
from ..data.population import EpisodeKey
from ..evaluate.arriving import Arriving, arriving
from ..identify.static_gains import static_gains
from ..observer import Observer
from ..observer.simulate import run_innovations
from ..uncertainty.outliers.quantities import Quantities
from .validation import spread

Array = npt.NDArray[np.float64]
Groups = Mapping[tuple[str, str], Sequence[EpisodeKey]]
Values = Mapping[str, Mapping[str, float]]
GAINS, POWERS = "static_gains", "residual_power"
FOLDER = "quantities"  # of a run
_KIND = "unit_quantities"
_AXES = {"values": "uq", "deviations": "uq", "floor": "q", "covariates": "cu"}
_EPISODES = 12  # of every unit and condition, at most
_BLOCKS = 8  # of an episode
_EXPLAINED = 0.5  # of the variance of a state's slow part: of less, its gains say nothing
_GAIN, _POWER_DB = 1e-3, 0.1  # differences that nobody looks at, of the ranges and in dB


@dataclass(frozen=True, eq=False)
class Ruler:
    """What is the same wherever quantities are measured.

    Parameters
    ----------
    block : int
        Samples that static gains take means of.
    ranges : mapping of str to float
        Of every channel in the study.
    states : tuple of str
        Whose static gains are sought.
    """

    block: int
    ranges: Mapping[str, float]
    states: tuple[str, ...]

    @classmethod
    def of(cls, observer: Observer, population: Population, groups: Groups) -> Ruler:
        """Take length of blocks and ranges from the study's recordings."""
        episodes = [population.read(keys[0]) for keys in groups.values()]
        block = max(int(np.median([len(e) for e in episodes])) // _BLOCKS, 1)
        size = np.max([np.abs(e).max(axis=0) for e in episodes], axis=0)
        names = [c.name for c in population.channels]
        return cls(block, dict(zip(names, size.tolist(), strict=True)), tuple(s for s in observer.recorded if s in names))

    def measure(
        self, observer: Observer, population: Population, groups: Groups, values: Values, work: Work | None = None
    ) -> dict[str, dict[str, Quantities]]:
        """Return the quantities of all units, by condition and table: `GAINS`, and `POWERS` where the observer has a monitor.

        Parameters
        ----------
        observer : Observer
        population : Population
        groups : mapping of (unit, condition) to sequence of EpisodeKey
        values : mapping of unit to mapping of str to float
            Lifting parameters; the observer's own where absent.
        work : Work, optional
        """
        tasks = [(self, observer, population.select([u], [c]), keys, values.get(u, {})) for (u, c), keys in groups.items()]
        measured = dict(zip(groups, (work or Work()).map("unit quantities", _measured, tasks), strict=True))
        tables, found = self._tables(observer), dict[str, dict[str, Quantities]]()
        for condition in dict.fromkeys(c for _, c in groups):
            units = tuple(u for u, c in groups if c == condition)
            rows, means = zip(*(measured[unit, condition] for unit in units), strict=True)
            beside = {c.name: np.array(means)[:, i] for i, c in enumerate(population.covariates)}
            found[condition] = {}
            for name, (names, floor) in tables.items():
                own, deviations = np.stack([row[name] for row in rows], axis=1)
                found[condition][name] = Quantities(units, names, own, deviations, floor, beside)
        return found

    def _tables(self, observer: Observer) -> dict[str, tuple[tuple[str, ...], Array]]:
        """Names of the quantities of every table, and differences that nobody looks at."""
        pairs = [(s, u) for s in self.states for u in observer.inputs]
        floor = np.array([_GAIN * self.ranges[s] / max(self.ranges[u], 1e-300) for s, u in pairs])
        found = {GAINS: (tuple(f"{s} / {u}" for s, u in pairs), floor)}
        if observer.monitor is not None:
            centres = observer.monitor.centres_hz(observer.sample_period_s)
            bands = tuple(f"{observer.lifting.states[i]} {hz:.3g} Hz" for i in observer.measured for hz in centres)
            found[POWERS] = bands, np.full(len(bands), _POWER_DB)
        return found

    def gains(self, observer: Observer, states: Sequence[str], found: Arriving) -> Array:
        """Return static gains and their deviations, shape (2, gains); those of states that inputs do not explain are not known."""
        ranges, batch = np.array([self.ranges[u] for u in observer.inputs]), found.batch
        there = [i for i, s in enumerate(self.states) if s in states]
        x = batch.states[..., [states.index(self.states[i]) for i in there]]
        episodes = list(enumerate(batch.lengths))
        own = static_gains([x[:n, e] for e, n in episodes], [found.u[:n, e] for e, n in episodes], self.block, ranges)
        both = np.full((2, len(self.states), len(ranges)), np.nan)
        both[:, there] = np.where((own.explained >= _EXPLAINED)[:, None], [own.gains, own.deviations], np.nan)
        return both.reshape(2, -1)


@dataclass(frozen=True, eq=False)
class UnitQuantities:
    """Quantities of a study's units, with what those of others are measured by.

    Parameters
    ----------
    ruler : Ruler
    tables : mapping of condition to mapping of str to Quantities
    """

    ruler: Ruler
    tables: Mapping[str, Mapping[str, Quantities]]

    @classmethod
    def of(cls, observer: Observer, population: Population, groups: Groups, values: Values, work: Work | None = None) -> UnitQuantities:
        """Measure the units of a study; arguments as in `Ruler.measure`."""
        ruler = Ruler.of(observer, population, groups)
        return cls(ruler, ruler.measure(observer, population, groups, values, work))

    def among(self, condition: str, name: str) -> Quantities:
        """Return the quantities of a table in a condition; of no unit where the study does not know it."""
        if condition in self.tables:
            return self.tables[condition][name]
        return replace(next(iter(self.tables.values()))[name].of([]), covariates={})

    def save(self, folder: Path) -> None:
        """Write ``arrays.npz`` and ``unit_quantities.json``."""
        tables = [(condition, name, own) for condition, named in self.tables.items() for name, own in named.items()]
        rows = [
            {"condition": c, "table": name, "unit_ids": q.unit_ids, "names": q.names, "covariates": list(q.covariates)}
            for c, name, q in tables
        ]
        arrays: dict[str, Array] = {}
        for k, (_, _, q) in enumerate(tables):
            covariates = np.array(list(q.covariates.values())).reshape(len(q.covariates), len(q.unit_ids))
            arrays |= {f"{name}_{k}": getattr(q, name) for name in ("values", "deviations", "floor")} | {f"covariates_{k}": covariates}
        save_artifact(folder, _KIND, {"ruler": self.ruler, "tables": rows}, arrays)

    @classmethod
    @loader
    def load(cls, folder: Path) -> UnitQuantities:
        """Read what `save` wrote."""
        content, arrays = load_artifact(folder, _KIND)
        tables: dict[str, dict[str, Quantities]] = {}
        for k, row in enumerate(content["tables"]):
            own = {name: arrays[f"{name}_{k}"] for name in _AXES}
            sizes = {"u": len(row["unit_ids"]), "q": len(row["names"]), "c": len(row["covariates"])}
            check_shapes(own, _AXES, sizes, folder)
            beside = dict(zip(row["covariates"], own.pop("covariates"), strict=True))
            tables.setdefault(row["condition"], {})[row["table"]] = Quantities(
                tuple(row["unit_ids"]), tuple(row["names"]), **own, covariates=beside
            )
        ruler = content["ruler"]
        return cls(Ruler(ruler["block"], dict(ruler["ranges"]), tuple(ruler["states"])), tables)


def _measured(task: tuple[Ruler, Observer, Population, Sequence[EpisodeKey], Mapping[str, float]]) -> tuple[dict[str, Array], Array]:
    """Quantities of one unit in one condition and their deviations by table, and means of what was recorded beside."""
    ruler, observer, population, keys, values = task
    keys = spread(keys, _EPISODES)
    found = arriving(observer, population, keys, {keys[0].unit: {**observer.parameters, **values}})
    with np.errstate(invalid="ignore"):
        means = [np.mean(population.read_covariates(key), axis=0) for key in keys if population.covariates]
        beside = np.mean(means, axis=0) if means else np.zeros(0)
    return {GAINS: ruler.gains(observer, population.states, found), POWERS: _powers(observer, found)}, beside


def _powers(observer: Observer, found: Arriving) -> Array:
    """Mean power of the innovation in every band, dB, and its deviation from episode to episode, shape (2, bands)."""
    monitor = observer.monitor
    if monitor is None:
        return np.zeros((2, 0))
    nu, judged = run_innovations(observer, found.y, found.u, found.parameters(observer, list(range(len(found.batch.keys)))), monitor.settle)
    judged &= np.arange(len(judged))[:, None] < found.batch.lengths
    squares, own = monitor.mean_squares(nu, judged), []
    for e in np.flatnonzero(judged.any(axis=0)):
        mean = squares[judged[:, e], e].mean(axis=0)
        own.append(10 * np.log10(np.maximum(mean.ravel(), 1e-30)))
    unknown = np.zeros(monitor.limits.size)
    if not own:
        return np.stack([unknown + np.nan, unknown])
    return np.stack([np.mean(own, axis=0), np.std(own, axis=0, ddof=1) / np.sqrt(len(own)) if len(own) > 1 else unknown])
