"""The native format: exact, lazy, whole or not at all."""

import json
import string
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from kros.core.errors import DataError
from kros.data import Channel, EpisodeKey, Population, Role, Unit, from_arrays, write_parquet
from kros.data.readers.parquet import group_file, read_parquet

CHANNELS = (Channel("x", Role.STATE, "m", measured=True), Channel("y/z", Role.STATE), Channel("u", Role.INPUT, "V"))


def values(seed: int, n: int = 30) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, 3))


def population(units: tuple[str, ...] = ("a", "b"), **changes: Any) -> Population:
    episodes = {
        EpisodeKey(u, c, str(e)): values(100 * i + 10 * j + e, 20 + e)
        for i, u in enumerate(units)
        for j, c in enumerate(("cold", "warm"))
        for e in range(3)
    }
    facts = [Unit(units[0], "outliers")]
    return from_arrays(
        {**episodes, **changes}, CHANNELS, 0.01, units=facts, metadata={"plant": "test", "gear_ratio": 100}
    )


def assert_same(found: Population, expected: Population) -> None:
    assert found.channels == expected.channels
    assert found.sample_period_s == expected.sample_period_s
    assert found.units == expected.units
    assert found.episodes == expected.episodes
    assert found.metadata == expected.metadata
    for key in expected.episodes:
        np.testing.assert_array_equal(found.read(key), expected.read(key))


def test_files_as_documented(tmp_path: Path) -> None:
    write_parquet(population(), tmp_path / "out")
    names = sorted(p.name for p in (tmp_path / "out").iterdir())
    assert names == ["a@cold.parquet", "a@warm.parquet", "b@cold.parquet", "b@warm.parquet", "population.json"]
    with pq.ParquetFile(tmp_path / "out" / "b@warm.parquet") as file:
        assert file.schema_arrow.names == ["unit", "condition", "episode", "k", "x", "y/z", "u"]
        assert [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)] == [20, 21, 22]
        row = file.read_row_group(2).slice(3, 1).to_pylist()[0]
    assert (row["unit"], row["condition"], row["episode"], row["k"]) == ("b", "warm", "2", 3)
    content = json.loads((tmp_path / "out" / "population.json").read_text())
    assert (content["schema"], content["kind"]) == (1, "population")
    group = {"unit": "a", "condition": "cold", "file": "a@cold.parquet", "digests": []}
    assert content["groups"][0] == group | {"episodes": ["0", "1", "2"], "samples": [20, 21, 22]}


def test_any_id_works(tmp_path: Path) -> None:
    odd = ("000123456789012345678901", "../etc", "a@b", "a%40b", "Größe 5 / links", "x.parquet", "a b")
    odd += ("x" * 300, "x" * 299 + "y", "ß" * 80)
    write_parquet(population(odd), tmp_path / "out")
    assert_same(read_parquet(tmp_path / "out"), population(odd))
    assert len(list((tmp_path / "out").iterdir())) == 2 * len(odd) + 1


@example(("a@b", "c"), ("a", "b@c"))
@example(("a" * 300, ""), ("a" * 300 + "b", ""))
@example(("a" * 299 + "c", ""), ("a" * 299 + "b", ""))
@given(*[st.tuples(*[st.text(max_size=40)] * 2)] * 2)
def test_file_names_differ_and_are_portable(one: tuple[str, str], other: tuple[str, str]) -> None:
    names = [group_file(*ids) for ids in (one, other)]
    assert (names[0] == names[1]) == (one == other)
    for name in names:
        assert len(name) <= 208
        assert set(name) <= set(string.ascii_letters + string.digits + "%@._-~")


def broken() -> Population:
    bad = population()
    samples = values(7)
    samples[4, 1] = np.nan
    bad.source.recordings.places[EpisodeKey("b", "warm", "1")] = samples, None  # type: ignore[attr-defined]
    return bad


def test_a_failed_conversion_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"Episode 1 of unit b \(warm\): channel 'y/z' has 1 NaN at sample 4"):
        write_parquet(broken(), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_existing_folders_are_kept(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    write_parquet(population(), out)
    (out / "mine.txt").write_text("keep")
    with pytest.raises(DataError, match="exists and is not empty"):
        write_parquet(population(("c",)), out)
    assert (out / "mine.txt").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="exists and is not empty"):
        write_parquet(population(), tmp_path / "file")


def test_channel_named_like_a_key_column(tmp_path: Path) -> None:
    channels = (Channel("k", Role.STATE), *CHANNELS[1:])
    with pytest.raises(DataError, match=r"channels \['k'\] have names of the columns of keys"):
        write_parquet(from_arrays({"a": [values(0)]}, channels, 0.01), tmp_path / "out")


def test_damaged_folders(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(DataError, match="there is no file"):
        read_parquet(out)
    write_parquet(population(), out)
    index = out / "population.json"
    good = index.read_text()
    index.write_text(good.replace('"schema": 1', '"schema": 99'))
    with pytest.raises(DataError, match="schema and kind should be"):
        read_parquet(out)
    index.write_text(good.replace('"role": "input"', '"role": "output"'))
    with pytest.raises(DataError, match="does not fit its checksum"):
        read_parquet(out)
    edited = good.replace('"checksum"', '"note"')  # as by somebody who edits the file on purpose
    index.write_text(edited.replace('"role": "input"', '"role": "output"'))
    with pytest.raises(DataError, match="not as kros writes it"):
        read_parquet(out)
    index.write_text(edited.replace("   20,", "   25,"))
    with pytest.raises(DataError, match=r"row group 0 should hold 25 samples .* found 20 of"):
        read_parquet(out).read(EpisodeKey("a", "cold", "0"))
    index.write_text(good)
    (out / "b@warm.parquet").write_bytes((out / "b@warm.parquet").read_bytes()[:200])
    with pytest.raises(DataError, match=r"b@warm\.parquet"):
        read_parquet(out).read(EpisodeKey("b", "warm", "0"))
    (out / "b@warm.parquet").unlink()
    with pytest.raises(DataError, match=r"1 files are missing, the first b@warm\.parquet"):
        read_parquet(out)


def test_a_file_that_was_written_anew_is_read_anew(tmp_path: Path) -> None:
    for name, units in (("one", ("a",)), ("two", ("b", "a"))):
        write_parquet(population(units), tmp_path / name)
    found, key = read_parquet(tmp_path / "one"), EpisodeKey("a", "cold", "0")
    found.read(key)
    (tmp_path / "two" / "a@cold.parquet").replace(tmp_path / "one" / "a@cold.parquet")
    np.testing.assert_array_equal(found.read(key), population(("b", "a")).read(key))
