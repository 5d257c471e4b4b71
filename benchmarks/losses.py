"""Random patterns of lost measurements on the observers of finished runs.

    python benchmarks/losses.py RUN RUN ... [--patterns 200]

Every pattern is independent loss of 10 to 95 %, a two-state Markov chain, or one long gap, at the beginning of a test episode: before
the time that the observer needs to be normal again, and at least over a quarter. Printed are the largest error of a state in its ranges,
and the largest distance from the undisturbed estimate at the end, in percent of the range.
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

LONGEST = 40_000


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
        print(run)
        for file in [run / "observers" / "deployed.json", *sorted((run / "observers").glob("[!r]*/*.json"))]:
            print(*tried(run, Observer.load(file), options.patterns), flush=True)


def tried(run: Path, observer: Observer, patterns: int) -> list[str]:
    """Return what is printed of an observer."""
    facts = json.loads((run / "population" / "facts.json").read_text())
    population, identified = read_parquet(run / facts["recordings"]), IdentifiedModels.load(run)
    keys = [key for key in identified.facts.test if key.unit in identified.parameters]
    rng = np.random.default_rng(0)
    chosen = [keys[i] for i in rng.integers(0, len(keys), patterns)]
    batch = EpisodeBatch.read(population, chosen, LONGEST, identified.parameters)
    batch = batch.head(int(batch.lengths.min()))
    n, y = len(population.states), batch.states[..., list(observer.measured)]
    designs = json.loads((run / "metrics.json").read_text())["observers"]
    settle = designs[observer.name].get("settle_samples") or 5 * observer.guard.settle
    first = max(len(y) // 4, len(y) - settle)
    lost = np.stack([pattern(rng, len(y), first) for _ in chosen], axis=1)
    values = observer.own(batch.parameters)
    undisturbed = run_observer(observer, y, batch.inputs, values)
    estimate = run_observer(observer, np.where(lost[..., None], np.nan, y), batch.inputs, values)
    ranges = np.abs(batch.states).max(axis=(0, 1))
    error = np.abs(estimate[..., :n] - batch.states).max(axis=(0, 1)) / ranges
    end = np.abs(estimate - undisturbed)[-1, :, :n].max(axis=0) / ranges
    return [
        f"{observer.name}, {patterns} patterns of {first} samples, {len(y) - first} good ones after them, needed {settle}:",
        "largest error, ranges:",
        ", ".join(f"{name} {e:.3g}" for name, e in zip(population.states, error, strict=True)),
        "; left at the end, percent:",
        ", ".join(f"{100 * e:.2g}" for e in end),
    ]


if __name__ == "__main__":
    main()
