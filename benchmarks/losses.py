"""Random patterns of lost measurements on the observers of finished runs.

    python benchmarks/losses.py RUN RUN ... [--patterns 200]

Only observers that are deployable are tried. Every pattern is independent loss of 10 to 95 %, a two-state Markov chain, or
one long gap, in the first half of a test episode. Printed are the largest error of a state in its ranges, and the largest
distance from the undisturbed estimate after the time that the observer needs to be normal again, in percent of the range.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from kros.data import EpisodeBatch
from kros.data.readers.parquet import read_parquet
from kros.identify import IdentifiedModels
from kros.observer import Observer, run_observer

LONGEST = 20_000  # samples of an episode
AT_ONCE = 50  # patterns
LARGEST = 300.0  # percent of the largest value, for which an observer is deployable


def pattern(rng: np.random.Generator, samples: int, half: int) -> np.ndarray:
    """Return which of the first samples are lost."""
    lost, kind = np.zeros(samples, dtype=bool), rng.integers(3)
    if kind == 0:
        lost[1:half] = rng.random(half - 1) < rng.uniform(0.1, 0.95)
    elif kind == 1:
        share, mean, state = rng.uniform(0.1, 0.95), np.exp(rng.uniform(0, np.log(half / 4))), False
        for k in range(1, half):
            leave = 1 / max(mean, 1.0)
            state = bool(rng.random() >= leave) if state else bool(rng.random() < leave * share / (1 - share))
            lost[k] = state
    else:
        start = int(rng.integers(1, half // 2))
        lost[start : start + int(rng.integers(1, half - start))] = True
    return lost


def main() -> None:
    """Try the deployed observer of every run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--patterns", type=int, default=200)
    options = parser.parse_args()
    for run in options.runs:
        designs = json.loads((run / "metrics.json").read_text())["observers"]
        for file in sorted((run / "observers").glob("[!r]*/*.json")):
            observer = Observer.load(file)
            if not designs[observer.name]["loss_error_percent"] < LARGEST:
                print(run, f"{observer.name}: not deployable")
                continue
            settle = designs[observer.name].get("settle_samples") or 5 * observer.guard.settle
            parts = [tried(run, observer, settle, seed) for seed in range(-(-options.patterns // AT_ONCE))]
            error, end = (np.max(values, axis=0) for values in zip(*parts, strict=True))
            print(run, f"{observer.name}, {AT_ONCE * len(parts)} patterns:")
            print(
                "  largest error, ranges:",
                *(f"{name} {e:.3g}" for name, e in zip(observer.recorded, error, strict=True)),
            )
            print(f"  left after {settle} samples, percent:", *(f"{100 * e:.2g}" for e in end), flush=True)


def tried(run: Path, observer: Observer, settle: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest errors in ranges, and what is left of the losses after some samples."""
    facts = json.loads((run / "population" / "facts.json").read_text())
    population, identified = read_parquet(run / facts["recordings"]), IdentifiedModels.load(run)
    keys = [key for key in identified.facts.test if key.unit in identified.parameters]
    rng = np.random.default_rng(seed)
    batch = EpisodeBatch.read(population, keys, LONGEST, identified.parameters)
    batch = batch.head(int(batch.lengths.min())).take(rng.integers(0, len(keys), AT_ONCE).tolist())
    n, y = len(population.states), batch.states[..., list(observer.measured)]
    samples, first = len(y), len(y) // 2
    again = 1 + -(-max(0, settle + 1 - first) // samples)  # the episode follows itself, until the observer has settled
    y, u = (np.tile(signals, (again, 1, 1)) for signals in (y, batch.inputs))
    lost = np.stack([pattern(rng, len(y), first) for _ in range(AT_ONCE)], axis=1)
    values = observer.own(batch.parameters)
    undisturbed = run_observer(observer, y, u, values)
    estimate = run_observer(observer, np.where(lost[..., None], np.nan, y), u, values)
    ranges = np.abs(batch.states).max(axis=(0, 1))
    error = np.abs(estimate[:samples, :, :n] - batch.states).max(axis=(0, 1)) / ranges
    end = np.abs(estimate - undisturbed)[first + settle, :, :n].max(axis=0) / ranges
    return error, end


if __name__ == "__main__":
    main()
