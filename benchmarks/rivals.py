"""The estimator and its rivals on machines that none of them knows: every unit of a study left out once.

    kros init FOLDER --measured voltage --input current --out study.toml
    python benchmarks/rivals.py study.toml
    python benchmarks/rivals.py examples/double_pendulum/study.toml --set data.source='"FOLDER"'

The estimator and ridge regression on a hundred delays are identified from the training episodes of all other units, with the lifting of the study; so are,
from scikit-learn, gradient boosting and a network of two layers, on delays, slow averages, the start and the time since. All estimate a sample from the
samples before it. Prints RMS errors of the states that are not measured on the held-out episodes of the unit that was left out, mean over these episodes,
and their ratios to the best rival's: of all samples, and of the first 50.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

import kros
from kros.data import EpisodeBatch, Population, split_episodes
from kros.design.baselines import make_learned
from kros.design.training import TrainingSet
from kros.lifting import Lifting
from kros.observer import EstimatorSettings, Recordings, identify_estimator, run_observer
from kros.observer.baselines.learned import Rows
from kros.study import Stage, load_config

METHODS = ("estimator", "ridge", "boosting", "network")
START = 50  # samples


def main() -> None:
    """Print a line for every unit and state, and their means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help="as for kros run"
    )
    options = parser.parse_args()
    config = load_config(options.study, options.settings)
    with tempfile.TemporaryDirectory() as scratch:
        kros.run(config, Path(scratch), until=Stage.READ)
        stored = [path.parent for path in Path(scratch).glob("*/population.json")]
        population = kros.read(stored[0] if stored else config.data.source)
        lifting = Lifting(population.states, config.lifting.functions or ())
        hidden = [i for i, name in enumerate(population.states) if name not in population.measured]
        found = []
        for unit in population.unit_ids:
            found.append(errors(population, unit, lifting, hidden, config.estimator))
            show(population, unit, hidden, found[-1])
        show(population, "mean", hidden, np.mean(found, axis=0))
        show(population, "worst", hidden, np.max(found, axis=0))


def errors(
    population: Population, unit: str, lifting: Lifting, hidden: list[int], settings: EstimatorSettings
) -> np.ndarray:
    """Return RMS errors on a unit left out, shape (methods, 2, hidden), of all samples and of the first."""
    others = population.select([u for u in population.unit_ids if u != unit])
    train = tuple(k for split in split_episodes(others).values() for k in split.train)
    training = TrainingSet(others, train, {u: {} for u in others.unit_ids})
    measured = tuple(population.states.index(name) for name in population.measured)
    recordings = Recordings.of(train, training.read_one)
    observer = identify_estimator(
        "estimator", lifting, measured, population.inputs, recordings, population.sample_period_s, settings=settings
    ).observer
    ridge, collected = make_learned(training, measured), Rows.of(training.one_by_one(), measured, recordings.lengths)
    regressions = [collected.fitted("boosting"), collected.fitted("network")]
    test = [k for split in split_episodes(population.select([unit])).values() for k in split.test]
    rows = []
    for batch in (EpisodeBatch.read(population, [key]) for key in test):
        y, truth = batch.measurements(measured), batch.states[:, 0][:, hidden]
        runs = [
            run_observer(observer, y, batch.inputs)[:, 0][:, hidden],
            ridge.estimate(batch.keys, y, batch.inputs, {})[:, 0][:, hidden],
        ]
        runs += [regression.run(y, batch.inputs)[:, 0][:, hidden] for regression in regressions]
        squares = np.array([(run - truth) ** 2 for run in runs])
        rows.append(np.sqrt([squares.mean(axis=1), squares[:, :START].mean(axis=1)]))
    return np.mean(rows, axis=0).swapaxes(0, 1)


def show(population: Population, name: str, hidden: list[int], found: np.ndarray) -> None:
    """Print errors."""
    for column, i in enumerate(hidden):
        channel = population.channels[i]
        for part, title in enumerate(("all samples", f"first {START}")):
            values = found[:, part, column]
            each = ", ".join(f"{method} {value:.4g}" for method, value in zip(METHODS, values, strict=True))
            ratio = values[0] / values[1:].min()
            sys.stdout.write(f"{name:12s} {channel.name} ({channel.unit}), {title}: {each}; ratio {ratio:.3f}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
