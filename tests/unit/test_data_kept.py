"""Episodes are kept in memory once read; a file that is written anew is read anew."""

import numpy as np
import pytest

import kros
from kros.data import write_parquet
from kros.data.readers.parquet import ArrayCache, read_parquet

RAMP = np.arange(40.0).reshape(20, 2)


def written(folder, value):
    episodes = {"a": [RAMP + value, RAMP + value + 1]}
    population = kros.from_arrays(episodes, states=["x"], measured=["x"], inputs=["u"], sample_period_s=0.01)
    write_parquet(population, folder)


def test_a_file_that_was_written_anew_is_read_anew(tmp_path):
    written(tmp_path / "one", 1.0)
    population = read_parquet(tmp_path / "one")
    key, other = population.episodes
    first = population.read(key)
    np.testing.assert_array_equal(first, RAMP + 1.0)
    np.testing.assert_array_equal(population.read(other), RAMP + 2.0)
    assert population.read(key) is first, "read once"
    written(tmp_path / "two", 5.0)
    (file,) = (tmp_path / "two").rglob("*.parquet")
    file.replace(next((tmp_path / "one").rglob("*.parquet")))
    np.testing.assert_array_equal(population.read(key), RAMP + 5.0)


def test_no_more_is_kept_than_stated_and_a_large_array_throws_nothing_out():
    kept = ArrayCache(limit=1000)
    for name in "abcd":
        kept.take(name, lambda: np.zeros(40))
    assert list(kept.arrays) == ["b", "c", "d"]
    assert kept.size == 960
    kept.take("b", lambda: pytest.fail("is there"))
    kept.take("large", lambda: np.zeros(1000))
    assert list(kept.arrays) == ["c", "d", "b"]
    assert kept.size == 960
