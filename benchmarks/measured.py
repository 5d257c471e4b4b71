"""The estimator on measured machines that it does not know: every unit of a study left out once.

    kros init FOLDER --measured voltage --input current --out study.toml
    python benchmarks/measured.py study.toml
    python benchmarks/measured.py examples/double_pendulum/study.toml --set data.source='"FOLDER"'

The estimator and the learned regression are identified from the training episodes of all other units, with the lifting of the study. Prints RMS errors of
the states that are not measured on the held-out episodes of the unit that was left out, mean over these episodes: of all samples, and of the first 50.
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
from kros.design.validation import TrainingSet
from kros.lifting import Lifting
from kros.observer import EstimatorSettings, Recordings, identify_estimator, run_observer
from kros.study import Stage, load_config

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
        population = kros.read(next(Path(scratch).glob("*/population.json")).parent)
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
    """Return RMS errors on a unit left out, shape (hidden, 4): estimator and learned, of all samples and of the first."""
    others = population.select([u for u in population.unit_ids if u != unit])
    train = tuple(k for split in split_episodes(others).values() for k in split.train)
    training = TrainingSet(others, train, {u: {} for u in others.unit_ids})
    measured = tuple(population.states.index(name) for name in population.measured)
    recordings = Recordings.of(train, training.read_one)
    observer = identify_estimator(
        "estimator", lifting, measured, population.inputs, recordings, population.sample_period_s, settings=settings
    ).observer
    learned = make_learned(training, measured)
    test = [k for split in split_episodes(population.select([unit])).values() for k in split.test]
    rows = []
    for batch in (EpisodeBatch.read(population, [key]) for key in test):
        truth = batch.states[:, 0][:, hidden]
        runs = (run_observer(observer, batch.measurements(measured), batch.inputs), learned.run(batch, {}))
        squares = [(run[:, 0][:, hidden] - truth) ** 2 for run in runs]
        rows.append([np.sqrt(part.mean(axis=0)) for part in (*squares, *(s[:START] for s in squares))])
    return np.mean(rows, axis=0).T


def show(population: Population, name: str, hidden: list[int], found: np.ndarray) -> None:
    """Print errors."""
    for i, (estimator, learned, start, learned_start) in zip(hidden, found, strict=True):
        channel = population.channels[i]
        sys.stdout.write(
            f"{name:12s} {channel.name:12s} estimator {estimator:.4g}, learned {learned:.4g} {channel.unit}, ratio {estimator / learned:.3f}; "
            f"first {START} samples {start:.4g}, {learned_start:.4g}, ratio {start / learned_start:.3f}\n"
        )
    sys.stdout.flush()


if __name__ == "__main__":
    main()
