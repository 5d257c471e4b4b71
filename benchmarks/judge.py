"""The judge: observers against their rivals on units that took no part in anything, over populations that nothing was designed on.

    python benchmarks/judge.py OUT                                   everything
    python benchmarks/judge.py OUT --populations stiff:3:401 --folds 0 --parts accuracy
    python benchmarks/judge.py OUT --table                           only print what is there

A population is ``kind:spread:seed[:variant]``: `stiff` and `soft` drives of the project's simulator, `compliant` ones of another (`judging/`), `dc`
motors with Coulomb friction; variant `limit` has a current limit that
the motion reaches, `cut` has episodes of 0.7 s. Its units are parted into three
folds, and for each everything is made from the other units with defaults. Parts: `accuracy`, errors of all observers on the test episodes of the
units left out, of their first 50 samples and of the rest, against the recording and the truth; `sensor`, the same where the position's sensor is
worse, of observers that were told of it and of those that were not. A result is a JSON file for each population, fold and part, and one that is
there is not made again.

The table gives, for each population: the deployed observers and their certificates; ratios to the learned estimator, mean over the units, its upper
95 % limit (bootstrap over the units, paired) and the worst unit; worst-case designs over the open loop of the same model; bounds over errors; and at
the limit the worst unit's current.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import traceback
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).parent / "judging"))

import compliant_drive  # noqa: E402
import numpy as np  # noqa: E402
from table import FOLDS, LEARNED, LIMITED, say, table  # noqa: E402

import kros  # noqa: E402
from kros.core import Work  # noqa: E402
from kros.core.artifacts import write_json  # noqa: E402
from kros.data import EpisodeBatch, EpisodeKey, Population, from_arrays, split_episodes  # noqa: E402
from kros.design.baselines import make_learned  # noqa: E402
from kros.design.settings import ObserverSettings, SynthesisSettings  # noqa: E402
from kros.design.synthesize import Designs, synthesize_all  # noqa: E402
from kros.design.training import TrainingSet  # noqa: E402
from kros.evaluate.errors import true_errors  # noqa: E402
from kros.evaluate.sensor import as_shown  # noqa: E402
from kros.identify.calibration import segments_of  # noqa: E402
from kros.observer import EstimatorSettings, Sensor, run_observer  # noqa: E402
from kros.plants import PLANTS  # noqa: E402
from kros.uncertainty.quantify import UncertainModels  # noqa: E402

START = 50  # samples of the start
UNITS, EPISODES, SECONDS = 12, 6, 10.0
CUT_S, LIMIT = 0.7, 0.33
LIMITS = {"stiff": 1.0, "soft": 1.0, "compliant": 1.0, "dc": 8.0}  # of the current
EVERYTHING = (  # what says most comes first
    *(
        "stiff:1:401",
        "compliant:1:401",
        "soft:3:401",
        "dc:1:401",
        "stiff:1:403:cut",
        "dc:1:403:cut",
        "compliant:1:403:limit",
    ),
    *(
        "stiff:3:401",
        "soft:1:401",
        "stiff:1:402",
        "soft:3:402",
        "compliant:1:402",
        "dc:1:402",
        "stiff:3:402",
        "soft:1:402",
    ),
)
SENSED = ("stiff:1:401", "compliant:1:401")  # populations and
SENSED_FOLDS = (0,)  # folds that the sensor is made worse for
LIFTINGS = {"compliant": (compliant_drive.LIFTING,), "dc": ("tanh(velocity)",)}


def sensors(size: float, step: float) -> dict[str, Sensor]:
    """Return the worse sensors of a position, by name, for its range and its resolution."""
    return {
        "noise": Sensor(noise=1e-5 * size),
        "late": Sensor(delay_samples=1),
        "dropout": Sensor(dropout=0.05),
        "coarse": Sensor(resolution=10 * step),
    }


@dataclass(frozen=True)
class Task:
    """One fold of one population, and the parts to make."""

    out: Path
    name: str
    fold: int
    parts: tuple[str, ...]
    units: int
    seconds: float

    @property
    def kind(self) -> str:
        """The simulator."""
        return self.name.split(":")[0]

    @property
    def variant(self) -> str:
        """What is special about the population; empty where nothing is."""
        return (*self.name.split(":"), "")[3]

    def place(self, part: str) -> Path:
        """Return where a part's result is kept."""
        return self.out / self.name.replace(":", "-") / f"{part}-{self.fold}.json"


def limit_of(task: Task) -> float:
    """Return the limit of the current."""
    return LIMIT if task.variant in LIMITED else LIMITS[task.kind]


def population_of(task: Task) -> Population:
    """Simulate a population."""
    kind, spread, seed = task.name.split(":")[:3]
    settings: dict[str, Any] = {
        "n_units": task.units,
        "n_episodes": EPISODES,
        "seconds": task.seconds,
        "seed": int(seed),
        "spread": float(spread),
    }
    if kind == "compliant":
        found, _ = compliant_drive.simulate(**settings, limit=limit_of(task))
    elif kind == "dc":
        found = PLANTS["dc-motor"](**settings).simulate().population
    else:
        found = PLANTS["harmonic-drive"](**settings, loop=kind).simulate().population
    return cut(found) if task.variant == "cut" else found


def cut(population: Population) -> Population:
    """Return a population with every episode cut into short ones, every other one left out but of the last episode, whose pieces are for testing."""
    length = round(CUT_S / population.sample_period_s)
    last = max(int(k.episode) for k in population.episodes)
    pieces = {}
    for key in population.episodes:
        values = population.read(key)
        for p in range(0, len(values) // length, 1 if int(key.episode) == last else 2):
            pieces[EpisodeKey(key.unit, key.condition, f"{key.episode}-{p}")] = values[p * length : (p + 1) * length]
    return from_arrays(
        pieces, population.channels, population.sample_period_s, units=population.units, metadata=population.metadata
    )


def held_out(task: Task, population: Population) -> tuple[str, ...] | None:
    """Return the names of the test episodes; None for the default."""
    if task.variant != "cut":
        return None
    last = population.episodes[-1].episode.split("-")[0]
    return tuple(dict.fromkeys(k.episode for k in population.episodes if k.episode.split("-")[0] == last))


class Fold:
    """What is made from the units that are not left out, once for all parts."""

    def __init__(self, task: Task) -> None:
        self.task, self.seconds = task, dict[str, float]()
        population = population_of(task)
        self.held = population.unit_ids[task.fold :: FOLDS]
        self.test = held_out(task, population)
        began = time.process_time()
        lifting = LIFTINGS.get(task.kind)
        models = kros.identify(
            population.select([u for u in population.unit_ids if u not in self.held]), lifting, test=self.test
        )
        self.seconds["identify"] = time.process_time() - began
        self.uncertain: UncertainModels = kros.quantify(models)
        self.seconds["quantify"] = time.process_time() - began - self.seconds["identify"]
        self.population = population.select(self.held)
        self._designs: Designs | None = None

    @property
    def designs(self) -> Designs:
        """Observers made with defaults."""
        if self._designs is None:
            self._designs = self.design({})
        return self._designs

    def design(self, sensor: Mapping[str, Sensor]) -> Designs:
        """Design all observers for a sensor."""
        began = time.process_time()
        baselines = ObserverSettings(baselines=("open_loop", "kalman_tuned"))
        found = synthesize_all(
            self.uncertain,
            SynthesisSettings(),
            baselines,
            EstimatorSettings(),
            sensor,
            Work(),
        )
        self.seconds["synthesize"] = time.process_time() - began
        return found

    def learned(self, sensor: Mapping[str, Sensor]) -> Any:
        """Train the learned estimator for a sensor."""
        models = self.uncertain.models
        first = models.models()
        return make_learned(TrainingSet.whole(models, first, sensor), first.measured)

    def batch(self, sensor: Mapping[str, Sensor]) -> EpisodeBatch:
        """Read the test episodes of the units left out, as a sensor shows them."""
        models, splits = self.uncertain.models, split_episodes(self.population, self.test)
        known: dict[str, dict[str, float]] = {}
        for unit in self.held if models.calibration is not None else ():
            assert models.calibration is not None
            on = splits.get((unit, models.facts.identify_on)) or next(s for (u, _), s in splits.items() if u == unit)
            spec = models.calibration.spec
            known[unit] = {
                spec.parameter: models.calibration.calibrate(
                    segments_of((self.population, on.train, spec)), unit
                ).phase_rad
            }
        keys = [k for split in splits.values() for k in split.test]
        return as_shown(
            EpisodeBatch.read(self.population, keys, parameters=known, truths=True), sensor, self.population.states
        )

    def estimates(self, designs: Designs, batch: EpisodeBatch, learned: Any) -> Iterable[tuple[str, np.ndarray]]:
        """Run all observers and the learned estimator."""
        for name, design in designs.designs.items():
            observer = design.observer
            values = batch.parameters if observer.lifting.parameters else None
            yield (
                name,
                run_observer(observer, batch.measurements(observer.measured), batch.inputs, values)[
                    ..., : batch.states.shape[-1]
                ],
            )
        yield (
            LEARNED,
            learned.estimate(batch.keys, batch.measurements(learned.measured), batch.inputs, batch.parameters),
        )

    def rows(self, designs: Designs, batch: EpisodeBatch, learned: Any, **case: Any) -> list[dict[str, Any]]:
        """Return errors in percent of the largest value of a unit in a condition, mean over its test episodes."""
        states, found = self.population.states, []
        groups = {
            g: [i for i, k in enumerate(batch.keys) if (k.unit, k.condition) == g]
            for g in dict.fromkeys((k.unit, k.condition) for k in batch.keys)
        }
        size = np.empty(batch.states.shape[1:])
        for chosen in groups.values():  # pieces in which the machine rests have no size of their own
            size[chosen] = np.abs(batch.states[:, chosen]).max(axis=(0, 1))
        for name, estimate in self.estimates(designs, batch, learned):
            with np.errstate(over="ignore", invalid="ignore"):
                square = (estimate - batch.states) ** 2
                parts = {"error_percent": square, "start_percent": square[:START], "rest_percent": square[START:]}
                percents = {what: 100 * np.sqrt(part.mean(axis=0)) / size for what, part in parts.items()}
            for (unit, condition), chosen in groups.items():
                for j, channel in enumerate(states):
                    row = {"observer": name, "unit": unit, "condition": condition, "channel": channel, **case}
                    found.append(row | {what: float(values[chosen, j].mean()) for what, values in percents.items()})
                    found[-1] |= true_row(self.population, estimate, batch, chosen, j)
        return found


def true_row(
    population: Population, estimate: np.ndarray, batch: EpisodeBatch, chosen: Sequence[int], state: int
) -> dict[str, float]:
    """Return error and lag against what a state really was."""
    if batch.truths is None or state not in population.true_states:
        return {}
    at, rows = population.true_states.index(state), list(chosen)
    dt = population.sample_period_s
    truth = batch.truths[:, rows][..., [at]], batch.lengths[rows], dt
    found = dict[str, np.ndarray]()
    for prefix, signals in (("", estimate), ("recorded_", batch.states)):
        errors = true_errors(signals[:, rows][..., [state]], *truth)
        found |= {f"{prefix}{name}": errors[name] for name in ("true_error_percent", "true_lag_s")}
    return {what: float(values.mean()) for what, values in found.items()}


def make(task: Task) -> dict[str, float]:
    """Make the missing parts of a fold; return the seconds of processor time that its steps took."""
    fold, seconds = Fold(task), dict[str, float]()
    for part in task.parts:
        began = time.process_time()
        content = {"accuracy": accuracy, "sensor": sensor}[part](fold)
        seconds[part] = time.process_time() - began
        write_json(
            task.place(part),
            {
                "population": task.name,
                "fold": task.fold,
                "held": fold.held,
                **content,
                "seconds": fold.seconds | seconds,
            },
        )
    return fold.seconds | seconds


def accuracy(fold: Fold) -> dict[str, Any]:
    """Errors of everything on the units left out, as recorded, with what is known about every observer."""
    designs = fold.designs
    batch, learned = fold.batch({}), fold.learned({})
    current, limit = batch.states[..., fold.population.states.index("current")], limit_of(fold.task)
    at_limit = (np.abs(current) > 0.97 * limit).mean(axis=0)
    return {
        "deployed": designs.deployed,
        "facts": designs.facts,
        "rows": fold.rows(designs, batch, learned),
        "learned": learned.facts,
        "at_limit": [[k.unit, k.condition, float(share)] for k, share in zip(batch.keys, at_limit, strict=True)],
    }


def sensor(fold: Fold) -> dict[str, Any]:
    """Errors with worse sensors, of observers that were told and of those that were not."""
    models, untold = fold.uncertain.models, fold.designs
    (measured,) = models.population.measured
    never_told, rows, deployed = fold.learned({}), [], {"": untold.deployed}
    for case, own in sensors(models.sizes[measured], models.facts.resolution[measured]).items():
        worse, told = {measured: own}, fold.design({measured: own})
        batch = fold.batch(worse)
        rows += fold.rows(untold, batch, never_told, case=case, told=False) + fold.rows(
            told, batch, fold.learned(worse), case=case, told=True
        )
        deployed[case] = told.deployed
    return {"deployed": deployed, "rows": rows}


def main() -> None:
    """Make what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--populations", nargs="+", default=list(EVERYTHING))
    parser.add_argument("--folds", type=int, nargs="+", default=list(range(FOLDS)))
    parser.add_argument("--parts", nargs="+", choices=("accuracy", "sensor"), default=["accuracy", "sensor"])
    parser.add_argument(
        "--sensed", nargs="+", default=list(SENSED), help="populations that the sensor is made worse for"
    )
    parser.add_argument("--sensed-folds", type=int, nargs="+", default=list(SENSED_FOLDS))
    parser.add_argument("--units", type=int, default=UNITS)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--again", action="store_true", help="make again what is there")
    parser.add_argument("--table", action="store_true")
    o = parser.parse_args()
    tasks = []
    for name in [] if o.table else o.populations:
        for fold in o.folds:
            wanted = [p for p in o.parts if p == "accuracy" or (name in o.sensed and fold in o.sensed_folds)]
            task = Task(o.out, name, fold, (), o.units, o.seconds)
            missing = tuple(p for p in wanted if o.again or not task.place(p).exists())
            tasks += [replace(task, parts=missing)] if missing else []
    tasks.sort(key=lambda task: -len(task.parts))  # the longest first
    with ProcessPoolExecutor(o.workers, get_context("spawn")) as pool:
        futures = {pool.submit(make, task): task for task in tasks}
        for future in as_completed(futures):
            task = futures[future]
            try:
                seconds = ", ".join(f"{k} {v:.0f}" for k, v in future.result().items())
                say(f"{task.name}, fold {task.fold}: {seconds} s")
            except Exception as error:  # whatever it is: the others are made all the same
                say(f"{task.name}, fold {task.fold} FAILED: {error}\n{''.join(traceback.format_exception(error)[-6:])}")
    table(o.out, o.populations)


if __name__ == "__main__":
    main()
