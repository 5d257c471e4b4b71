"""The mean profile against averages written down here, and what it refuses."""

import numpy as np
import pytest

import kros
from kros.core.errors import DataError
from kros.data import EpisodeBatch
from kros.data.population import EpisodeKey, Population
from kros.design.baselines import make_mean_profile
from kros.design.training import TrainingSet

N = 60
RNG = np.random.default_rng(0)
MOTIONS = RNG.normal(size=(2, N, 1))


def recorded(episodes: dict[str, list[int]], noise: float = 0.0) -> tuple[Population, dict[str, list[np.ndarray]]]:
    """Units with episodes of motion 0 or 1, states of their own."""
    data = {
        unit: [
            np.concatenate([RNG.normal(size=(N, 2)), MOTIONS[m] + noise * RNG.normal(size=(N, 1))], axis=1)
            for m in motions
        ]
        for unit, motions in episodes.items()
    }
    names = {"states": ("x", "v"), "inputs": ("u",), "measured": ["x"]}
    return kros.from_arrays(data, **names, sample_period_s=0.01), data


def training(population: Population, last: int) -> tuple[TrainingSet, list[EpisodeKey]]:
    """All episodes but the last of every unit, and those."""
    keys = [population.keys(unit) for unit in population.unit_ids]
    known: dict[str, dict[str, float]] = {unit: {} for unit in population.unit_ids}
    return TrainingSet(population, tuple(k for own in keys for k in own[:last]), known), [own[last] for own in keys]


def test_it_is_the_mean_of_the_other_units_at_the_same_sample() -> None:
    population, data = recorded({"a": [0, 1, 0, 1], "b": [1, 0, 1, 0], "c": [0, 0, 1, 1]})
    train, test = training(population, 3)
    made = make_mean_profile(train, (0,), population, test)
    batch = EpisodeBatch.read(population, test)

    def estimate(part):
        return made.estimate(part.keys, part.measurements((0,)), part.inputs, {})

    found = estimate(batch)
    assert np.isnan(found[..., 0]).all()
    mean = {
        "a": (data["b"][0] + data["b"][2] + 2 * data["c"][2]) / 4,  # motion 1
        "b": ((data["a"][0] + data["a"][2]) / 2 + (data["c"][0] + data["c"][1]) / 2) / 2,
        "c": (data["a"][1] + (data["b"][0] + data["b"][2]) / 2) / 2,
    }
    for i, unit in enumerate("abc"):
        np.testing.assert_allclose(found[:, i, 1], mean[unit][:, 1], rtol=1e-12)
    lost = batch.measurements((0,)).copy()
    lost[10:40] = np.nan  # a gap after which observers start again does not set the motion back
    np.testing.assert_array_equal(made.estimate(batch.keys, lost, batch.inputs, {}), found)
    short = batch.head(25)
    np.testing.assert_array_equal(estimate(short), found[:25])


def test_inputs_that_differ_are_another_motion() -> None:
    population, _ = recorded({"a": [0, 0, 1], "b": [0, 0, 1], "c": [0, 0, 1]})
    train, test = training(population, 2)
    match = r"the inputs of held-out .* do not occur in training episodes of two units"
    with pytest.raises(DataError, match=match):
        make_mean_profile(train, (0,), population, test)
    nearly, _ = recorded({"a": [0, 0], "b": [0, 0]}, noise=1e-3)
    train, test = training(nearly, 1)
    assert make_mean_profile(train, (0,), nearly, test).facts["motions"] == 1
    with pytest.raises(DataError, match="a state that is not measured"):
        make_mean_profile(train, (0, 1), nearly, test)
