"""Settings, shapes and seeds of the simulated DC motors, and the command that writes them."""

from __future__ import annotations

import json

from typer.testing import CliRunner

from kros.cli import app
from kros.data import EpisodeKey
from kros.data.readers.parquet import read_parquet
from kros.plants import PLANTS, DcMotorPopulation

SMALL = DcMotorPopulation(n_units=3, n_episodes=2, seconds=2.0, seed=4, outlier=True)
KEY = EpisodeKey("002", "default", "1")


def test_population_has_three_states_and_an_input():
    population = SMALL.simulate().population
    assert (population.states, population.inputs) == (("position", "velocity", "current"), ("voltage",))
    assert population.measured == ("position",)
    assert population.unit_ids == ("000", "001", "002", "003")
    assert population.unit("000").group == "outliers"
    assert population.read(KEY).shape == (1000, 4)
    assert len(population.episodes) == 8


def test_the_command_writes_motors_with_their_truth(tmp_path):
    options = ("--plant", "dc-motor", "--units", 2, "--episodes", 2, "--seconds", 5)
    result = CliRunner().invoke(app, ["simulate", str(tmp_path / "motors"), *map(str, options)])
    assert result.exit_code == 0, result.output
    assert read_parquet(tmp_path / "motors").metadata["plant"] == "dc-motor"
    assert json.loads((tmp_path / "motors" / "truth.json").read_text())["plant"] == "dc-motor"
    assert PLANTS["dc-motor"] is DcMotorPopulation
