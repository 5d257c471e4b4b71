"""Settings, shapes and seeds of the simulated pendulums."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from kros.data import EpisodeKey
from kros.plants import PendulumPopulation

SMALL = PendulumPopulation(n_units=3, n_episodes=2, seconds=4.0, seed=4, outlier=True)
KEY = EpisodeKey("002", "default", "1")


def test_population_has_two_states_and_an_input():
    population = SMALL.simulate().population
    assert (population.states, population.inputs, population.measured) == (
        ("position", "velocity"),
        ("torque",),
        ("position",),
    )
    assert population.unit_ids == ("000", "001", "002", "003")
    assert population.unit("000").group == "outliers"
    assert len(population.episodes) == 8
    assert population.read(KEY).shape == (400, 3)
    assert np.abs(population.read(KEY)[:, 0]).max() > 0.3


def test_truth_is_plain_json_and_the_outlier_is_stiff_jointed():
    truth = json.loads(json.dumps(replace(SMALL, spread=0.0).simulate().truth.as_dict()))
    good, bad = truth["units"]["001"], truth["units"]["000"]
    assert good == {"gravity": 20.0, "damping": 0.8, "gain": 6.0}
    assert bad["damping"] > 2 * good["damping"]
