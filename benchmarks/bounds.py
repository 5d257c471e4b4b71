"""How often does a new machine exceed the largest error in an episode that was left out of the estimator's regression with its unit?

    python benchmarks/bounds.py 60

Populations of simulated drives and DC motors in turn, five episodes of six seconds: eight machines train the estimator on four episodes, four others are
judged on the fifth. Prints the errors beyond the bound of every population, and their number with a binomial test of one in nine.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.stats import binomtest

from kros.data import EpisodeBatch, split_episodes
from kros.lifting import Lifting
from kros.observer import Recordings, identify_estimator, run_observer
from kros.plants import PLANTS

UNITS, TRAINED = 12, 8


def ratios(plant: str, seed: int) -> np.ndarray:
    """Return the errors of hidden states of new machines over their bounds, the worst condition of each."""
    simulated = PLANTS[plant](n_units=UNITS + 1, n_episodes=5, seconds=6.0, seed=seed).simulate().population
    units, measured = (
        list(simulated.unit_ids)[:UNITS],
        tuple(simulated.states.index(name) for name in simulated.measured),
    )
    trained, new = simulated.select(units[:TRAINED]), simulated.select(units[TRAINED:])
    keys = [key for split in split_episodes(trained).values() for key in split.train]
    recordings = Recordings.of(keys, lambda key: EpisodeBatch.read(trained, [key]))
    channels = Lifting(simulated.states), measured, simulated.inputs
    identified = identify_estimator("estimator", *channels, recordings, simulated.sample_period_s)
    bound = np.array([identified.facts["left_out_worst_percent"][name] for name in simulated.states])
    hidden = [i for i in range(len(simulated.states)) if i not in measured]
    worst: dict[str, np.ndarray] = {}
    for key in (key for split in split_episodes(new).values() for key in split.test):
        batch = EpisodeBatch.read(new, [key])
        estimate = run_observer(identified.observer, batch.measurements(measured), batch.inputs)
        error = 100 * np.sqrt(((estimate[..., : len(bound)] - batch.states) ** 2).mean(axis=(0, 1))) / recordings.size
        worst[key.unit] = np.maximum(worst.get(key.unit, 0.0), error / bound)
    return np.array(list(worst.values()))[:, hidden]


def main() -> None:
    """Print a line for every population, and the whole."""
    count, found = int(sys.argv[1]), []
    for number in range(count):
        plant = ("harmonic-drive", "dc-motor")[number % 2]
        found.append(ratios(plant, 1000 + number))
        sys.stdout.write(f"{number} {plant}: {int((found[-1] > 1).sum())} of {found[-1].size} beyond the bound\n")
        sys.stdout.flush()
    every = np.concatenate([one.ravel() for one in found])
    beyond, stated = int((every > 1).sum()), 1 / (TRAINED + 1)
    probability = binomtest(beyond, every.size, stated, alternative="greater").pvalue
    sys.stdout.write(f"{beyond} of {every.size} beyond the bound, {100 * stated:.1f} % stated (p {probability:.2g}); ")
    sys.stdout.write(f"bound over error {1 / np.median(every):.2f} in the median\n")


if __name__ == "__main__":
    main()
