"""What every number of the estimator is worth: errors on machines left out with and without it.

    python benchmarks/ablation.py OUT [POPULATION ...]
    python benchmarks/ablation.py OUT --table

A population is one of `judge.py`, such as ``compliant:1:401``, or a study file whose data are there. Its units are
parted into folds, and for every variant of the settings an estimator is identified from the other units. Errors are RMS
of the hidden states on test episodes, as recorded, with half of the measurements lost, independently and in bursts, and
over a start in the middle; the table has their ratios to the defaults, geometric means over states and units. A result
is one JSON file for each population and variant; one that is there is not made again.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import judge
import numpy as np

import kros
from kros.core.artifacts import read_json, write_json
from kros.data import EpisodeBatch, Population, split_episodes
from kros.design.training import TrainingSet
from kros.lifting import Lifting
from kros.observer import EstimatorSettings, Recordings, identify_estimator, run_observer
from kros.study import Stage, load_config

POPULATIONS = ("stiff:1:401", "soft:3:401", "compliant:1:401", "dc:1:401", "stiff:1:403:cut")
FOLDS, BURST, START = 2, 50, 100  # folds of three that are judged; mean samples of a burst; those of a start
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "delays alone": {"margin": 1e6},
    "richer families without a margin": {"margin": 0.0},
    "no random features": {"features": 0},
    "delays = 30": {"delays": 30},
    "delays = 200": {"delays": 200},
    "first_lag = 64": {"first_lag": 64.0},
    "lag_ratio = 4": {"lag_ratio": 4.0},
    "last_lag = 0.4": {"last_lag": 0.4},
    "last_lag = 0.03": {"last_lag": 0.03},
    "start = []": {"start": ()},
    "start_share = 1e-6": {"start_share": 1e-6},
    "restart_share = 1": {"restart_share": 1.0},
    "restart_share = 1e-6": {"restart_share": 1e-6},
    "settled_share = 1e-6": {"settled_share": 1e-6},
    "start_rows = 0": {"start_rows": 0.0},
    "nonlinear_trust = 0": {"nonlinear_trust": 0.0},
    "beyond = 0": {"beyond": 0.0},
    "penalties = [1e-16]": {"penalties": (1e-16,)},
    "parts = 1": {"parts": 1},
    "loss = 0.001": {"loss": 0.001},
    "loss = 0.1": {"loss": 0.1},
    "measured_loss = 1": {"measured_loss": 1.0},
    "halves = [0.1]": {"halves": (0.1,)},
    "gate = 1e6": {"gate": 1e6},
    "room = 10": {"room": 10.0},
    "gap_samples = 60000": {"gap_samples": 60_000},
    "gap_episodes = 8": {"gap_episodes": 8},
    "rows = 20000": {"rows": 20_000},
    "sample = 3000": {"sample": 3000},
}


def main() -> None:
    """Make what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("populations", nargs="*", default=POPULATIONS)
    parser.add_argument("--variants", nargs="+", default=tuple(VARIANTS))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="only print what is there")
    options = parser.parse_args()
    tasks = [] if options.table else [(options.out, *task) for task in product(options.populations, options.variants)]
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        list(pool.map(make, *zip(*tasks, strict=True)) if tasks else ())
    sys.stdout.write(table(options.out))


def make(out: Path, name: str, variant: str) -> None:
    """Judge one variant on one population."""
    place = out / Path(name).stem.replace(":", "-") / f"{variant}.json"
    if place.exists():
        return
    with tempfile.TemporaryDirectory() as scratch:
        population, test, functions = opened(name, Path(scratch))
        errors = [judged(population, test, functions, fold, VARIANTS[variant]) for fold in range(FOLDS)]
    write_json(place, {part: [row for one in errors for row in one[part]] for part in errors[0]})


def opened(name: str, scratch: Path) -> tuple[Population, Any, tuple[str, ...]]:
    """Return a population, its test episodes and its lifting."""
    if name.endswith(".toml"):
        config = load_config(Path(name))
        kros.run(config, scratch, until=Stage.READ)
        stored = [path.parent for path in scratch.glob("*/population.json")]
        source = stored[0] if stored else config.data.source
        return kros.read(source), config.split.test, tuple(config.lifting.functions or ())
    task = judge.Task(scratch, name, 0, (), judge.UNITS, judge.SECONDS)
    population = judge.population_of(task)
    return population, judge.held_out(task, population), ()


def judged(
    population: Population, test: Any, functions: tuple[str, ...], fold: int, settings: dict[str, Any]
) -> dict[str, list[list[float]]]:
    """Return logarithms of the errors of hidden states on test episodes of a fold's units, (episodes, hidden)."""
    ids, measured = population.unit_ids, tuple(population.states.index(name) for name in population.measured)
    held = ids[fold :: judge.FOLDS]
    others = population.select([unit for unit in ids if unit not in held])
    train = tuple(k for split in split_episodes(others, test).values() for k in split.train)
    training = TrainingSet(others, train, {unit: {} for unit in others.unit_ids})
    identified = identify_estimator(
        "estimator",
        Lifting(population.states, functions),
        measured,
        population.inputs,
        Recordings.of(train, training.read_one),
        population.sample_period_s,
        settings=EstimatorSettings(**settings),
    )
    hidden = [i for i in range(len(population.states)) if i not in measured]
    found: dict[str, list[list[float]]] = {"recorded": [], "lost": [], "bursts": [], "started": []}
    keys = [k for split in split_episodes(population.select(held), test).values() for k in split.test]
    for number, key in enumerate(keys):
        batch, rng = EpisodeBatch.read(population, [key]), np.random.default_rng(number)
        y = batch.measurements(measured)
        bursts = np.repeat(np.arange(len(y)) % 2 == 1, rng.geometric(1 / BURST, len(y)))[: len(y)]
        for part, lost in (("recorded", []), ("lost", rng.random(len(y)) < 0.5), ("bursts", bursts)):
            some = y.copy()
            some[1:][np.asarray(lost[1:], dtype=bool)] = np.nan
            estimate = run_observer(identified.observer, some, batch.inputs)[..., hidden]
            found[part].append(log_rms(estimate - batch.states[..., hidden]))
        some = slice(len(y) // 2, len(y) // 2 + START)
        estimate = run_observer(identified.observer, y[some], batch.inputs[some])[..., hidden]
        found["started"].append(log_rms(estimate - batch.states[some][..., hidden]))
    return found


def log_rms(errors: np.ndarray) -> list[float]:
    """Return the logarithms of the RMS of errors (n_samples, batch, n)."""
    return (np.log(np.mean(errors**2, axis=(0, 1))) / 2).tolist()


def table(out: Path) -> str:
    """Return ratios to the defaults as a table in Markdown: as recorded, half lost, half in bursts, over a start."""
    names = [path.name for path in sorted(out.iterdir()) if (path / "default.json").exists()]
    lines = [f"| setting | {' | '.join(names)} |", f"|---|{'---|' * len(names)}"]
    for variant in VARIANTS:
        cells = []
        for name in names:
            place = out / name / f"{variant}.json"
            one, other = (read_json(p) if p.exists() else {} for p in (place, out / name / "default.json"))
            ratios = [np.exp(np.mean(np.subtract(one[part], other[part]))) for part in one]
            cells.append("/".join(f"{ratio:.2f}" for ratio in ratios))
        lines.append(f"| {variant} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
