"""What was recorded beside stays beside the recordings: kept by readers and writers, seen by no model, and it may be missing from files."""

from pathlib import Path

import numpy as np
import pytest

from kros.core.artifacts import read_json
from kros.data import (
    Channel,
    EpisodeBatch,
    Population,
    Role,
    TrueChannel,
    from_arrays,
    prepare,
    read_csv_folder,
    read_parquet,
    steps,
    write_parquet,
)
from kros.data.survey import survey

CHANNELS = (Channel("x", Role.STATE, measured=True), Channel("u", Role.INPUT))
BESIDE = (Channel("temperature", Role.COVARIATE, "degC"), TrueChannel("x_true", Role.TRUTH, of="x"))


def recorded(beside: tuple[Channel, ...] = BESIDE) -> Population:
    """Two units with two episodes; what is beside comes first in the arrays."""
    rng = np.random.default_rng(3)
    data = {unit: [rng.standard_normal((40 + e, 4)) for e in range(2)] for unit in "ab"}
    return from_arrays({u: [e[:, 2 - len(beside) :] for e in episodes] for u, episodes in data.items()}, (*beside, *CHANNELS), 0.1)


def test_a_covariate_is_no_channel(tmp_path: Path) -> None:
    population, plain = recorded(), recorded(())
    assert population.channels == plain.channels == CHANNELS
    assert (population.covariates, population.truths) == (BESIDE[:1], BESIDE[1:])
    assert repr(population) == repr(plain)[:-1] + "; true x; covariates temperature)"
    batch, same = EpisodeBatch.read(population, population.episodes, truths=True), EpisodeBatch.read(plain, plain.episodes)
    np.testing.assert_array_equal(batch.states, same.states)
    assert batch.truths is not None
    assert batch.truths.shape[2] == 1
    for key in plain.episodes:
        np.testing.assert_array_equal(population.read(key), plain.read(key))
        np.testing.assert_array_equal(population.read_covariates(key)[:, 0], population.source(key)[:, 3])
    assert survey(population)[1].train == survey(plain)[1].train


def test_covariates_are_written_and_prepared(tmp_path: Path) -> None:
    population = prepare(recorded(), [steps.Trim(start=3), steps.Scale(("temperature",), 2.0, "K")])
    write_parquet(population, tmp_path / "beside")
    write_parquet(recorded(()), tmp_path / "plain")
    again = read_parquet(tmp_path / "beside")
    assert again.covariates == (Channel("temperature", Role.COVARIATE, "K"),)
    for key in population.episodes:
        np.testing.assert_array_equal(again.read_covariates(key)[:, 0], 2 * recorded().read_covariates(key)[3:, 0])
    assert "covariates" not in read_json(tmp_path / "plain" / "population.json")


@pytest.mark.parametrize("there", [True, False])
def test_a_file_may_be_without_it(there: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    values = np.column_stack([0.1 * np.arange(50), rng.normal(size=(50, 2)), np.full(50, 21.5)])
    names = ["t", "x", "u", "temperature"][: 4 if there else 3]
    np.savetxt(tmp_path / "a_1.csv", values[:, : len(names)], delimiter=",", header=",".join(names), comments="")
    mapping = {
        "files": r"(?P<unit>[a-z]+)_(?P<episode>\d+)[.]csv",
        "time": "t",
        "channel": [
            {"name": "temperature", "role": "covariate"},
            {"name": "x", "role": "state", "measured": True},
            {"name": "u", "role": "input"},
        ],
    }
    population = read_csv_folder(tmp_path, mapping, optional=("z",))
    assert [c.name for c in population.covariates] == ["temperature"] * there
    assert population.read(population.episodes[0]).shape == (50, 2)
