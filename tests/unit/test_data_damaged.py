"""Recordings that are none, or not those they are said to be: refused with a reason, in bounded time and memory."""

import gzip
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyarrow import parquet
from scans import scan_digests

from kros.core import limits
from kros.core.errors import DataError
from kros.data import Channel, EpisodeKey, Role, from_arrays, prepare, read, steps, write_parquet
from kros.data.readers.parquet import read_parquet

CHANNELS = (Channel("x", Role.STATE, measured=True), Channel("v", Role.STATE), Channel("u", Role.INPUT))
MAPPING: dict[str, Any] = {
    "files": r"(?P<unit>[a-z]+)\.(csv|txt)",
    "time": "t",
    "channel": [{"name": c.name, "column": c.name, "role": c.role.value, "measured": c.measured} for c in CHANNELS],
}
GOOD = b"t,x,v,u\n" + b"".join(
    b"%.2f,%.4f,%.4f,%.4f\n" % (k / 100, np.sin(k), np.cos(k), np.sin(3 * k)) for k in range(50)
)


def samples(seed: int, n: int = 80) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, 3)).cumsum(axis=0)


def scan(folder: Path, **mapping: Any) -> Any:
    found = read(folder, "csv", mapping={**MAPPING, **mapping})
    scan_digests(found)
    return found


# ------------------------------------------------------------------------------------------------- files of text
@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "empty"),
        (b"\n", "empty"),
        (b"t,x,v,u\n", "at least two samples"),
        (b"1" * 5_000_000, "a line at the start is longer"),
        (b"t,x,v," + b"u" * 200_000 + b"\n0,1,2,3\n", "no list of columns"),
        (b't,x,v,"u\n0,1,2,3\n', "u"),
        (b"t,x,x,u\n0,1,2,3\n", r"a\.csv: column 'x' occurs 2 times"),
        (b"t,y,v,u\n0,1,2,3\n", r"a\.csv: column 'x' is missing; found \['t', 'y', 'v', 'u'\]"),
        (GOOD.decode().encode("utf-16"), "UTF-16"),
        (GOOD.decode().encode("utf-16-le"), "UTF-16"),
        (GOOD.replace(b"t,x", b"t\xff,x"), "not UTF-8"),
        (GOOD + b"0.5,1\0,2,3\n", "'x'"),
        (GOOD + b"0.5," + b"1" * 9_000_000 + b",2,3\n", r"longer than|out of range|'x'"),
        (GOOD + b'0.5,"1,2,3\n' * 3, r"."),
    ],
    ids=range(14),
)
def test_text_that_is_no_table(tmp_path: Path, content: bytes, found: str) -> None:
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(DataError, match=found):
        scan(tmp_path)


def bomb(path: Path, line: bytes, megabytes: int) -> None:
    with gzip.open(path, "wb", compresslevel=1) as file:
        file.write(b"t,x,v,u\n")
        for _ in range(megabytes):
            file.write(line * ((1 << 20) // len(line)))


@pytest.mark.parametrize("line", [b"0,0,0,0\n", b"\n", b"0"])
def test_little_that_unpacks_to_much(tmp_path: Path, line: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "MAX_TEXT_BYTES", 1 << 22)
    bomb(tmp_path / "a.csv.gz", line, 20)
    with pytest.raises(DataError, match=r"unpacks to more than|longer than|at least two samples"):
        scan(tmp_path)


@pytest.mark.parametrize("at", [2, 15, 300, -5, -1])
def test_packed_text_that_is_damaged(tmp_path: Path, at: int) -> None:
    packed = bytearray(gzip.compress(GOOD))
    packed[at] ^= 0x55
    (tmp_path / "a.csv.gz").write_bytes(packed)
    with pytest.raises(DataError, match=r"a\.csv\.gz"):
        scan(tmp_path)
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(GOOD)[:at])
    with pytest.raises(DataError, match=r"a\.csv\.gz"):
        scan(tmp_path)


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "broken link"])
@pytest.mark.parametrize("layout", ["csv", "motor-drive-raw"])
def test_recordings_that_are_no_files(tmp_path: Path, layout: str, kind: str) -> None:
    folder = tmp_path / ("." if layout == "csv" else "batch_b/population/20230101T000000_001001_load")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / ("a.csv" if layout == "csv" else "001.csv")
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
        (tmp_path / "b.csv").write_bytes(GOOD)
    else:
        path.symlink_to("/dev/zero" if kind == "device" else "nowhere")
    if (layout, kind) == ("csv", "folder"):
        assert scan(tmp_path).unit_ids == ("b",)  # a folder is looked into, not read
        return
    with pytest.raises(DataError, match=r"regular file|there is no file|no file matches"):
        read(tmp_path, layout, mapping=MAPPING if layout == "csv" else None)


def test_names_that_no_table_can_show(tmp_path: Path) -> None:
    with open(os.fsencode(tmp_path) + b"/\xff\xfea.csv", "wb") as file:
        file.write(GOOD)
    with pytest.raises(DataError, match="printable"):
        scan(tmp_path, files=r"(?P<unit>.+)\.csv")


# -------------------------------------------------------------------------------------- periods, cut-offs, names
@pytest.mark.parametrize("period", [0, -0.01, float("nan"), float("inf"), "0.01", None, True])
def test_periods_that_are_none(period: Any) -> None:
    with pytest.raises(DataError, match="sampling period should be a number of seconds above zero"):
        from_arrays({"a": [samples(0)]}, CHANNELS, period)


def test_resampling_to_more_samples_than_anybody_wants() -> None:
    tiny = prepare(from_arrays({"a": [samples(0)]}, CHANNELS, 0.01), [steps.Resample(1e-12)])
    with pytest.raises(DataError, match="would make"):
        tiny.read(tiny.episodes[0])


@pytest.mark.parametrize("name", ["", " ", "a\nb", "a\0", "\udcff"])
def test_names_that_are_none(name: str) -> None:
    for data in ({name: [samples(0)]}, {"a": {name: [samples(0)]}}, {EpisodeKey("a", "c", name): samples(0)}):
        with pytest.raises(DataError, match="name"):
            from_arrays(data, CHANNELS, 0.01)
    with pytest.raises(DataError, match="channel"):
        from_arrays({"a": [samples(0)]}, (Channel(name, Role.STATE, measured=True), *CHANNELS[1:]), 0.01)
    with pytest.raises(DataError, match="channel"):
        prepare(from_arrays({"a": [samples(0)]}, CHANNELS, 0.01), [steps.Differentiate("x", name, 5.0)])


# ----------------------------------------------------------------------------------------------------- in memory
@pytest.mark.parametrize(
    "values",
    [samples(0).astype(complex), samples(0).astype(str), samples(0).astype("datetime64[s]"), [[1, "2", 3]] * 9],
)
def test_arrays_that_hold_no_numbers(values: Any) -> None:
    with pytest.raises(DataError, match=r"Episode 0 of unit a .* needs numbers"):
        from_arrays({"a": [values]}, CHANNELS, 0.01)


# ------------------------------------------------------------------------------------------------------- Parquet
@pytest.fixture
def stored(tmp_path: Path) -> Path:
    write_parquet(
        from_arrays({u: [samples(i), samples(10 + i)] for i, u in enumerate("ab")}, CHANNELS, 0.01), tmp_path / "p"
    )
    return tmp_path / "p"


def rewrite(path: Path, change: Any) -> None:
    with parquet.ParquetFile(path) as file:
        groups = [file.read_row_group(i) for i in range(file.num_row_groups)]
    tables = [change(table) for table in groups]
    with parquet.ParquetWriter(path, tables[0].schema) as writer:
        for table in tables:
            writer.write_table(table)


@pytest.mark.parametrize("kind", [pa.float16(), pa.float32(), pa.string(), pa.int64()])
def test_columns_of_another_type(stored: Path, kind: Any) -> None:
    def change(table: Any) -> Any:
        at = table.schema.get_field_index("v")
        return table.set_column(at, "v", table["v"].cast(kind, safe=False))

    rewrite(stored / "a@default.parquet", change)
    match = r"a@default\.parquet: row group 0 should hold .* as double, found .*\b(halffloat|float|string|int64)"
    with pytest.raises(DataError, match=match):
        scan_digests(read_parquet(stored))


@pytest.mark.parametrize("label", ["unit", "condition", "episode"])
def test_labels_that_disagree_with_the_index(stored: Path, label: str) -> None:
    def change(table: Any) -> Any:
        at = table.schema.get_field_index(label)
        return table.set_column(at, label, pa.array([*["other"] * 5, *table[label].to_pylist()[5:]]))

    rewrite(stored / "a@default.parquet", change)
    with pytest.raises(DataError, match=r"80 samples of episode 0 of unit a \(default\) .* found 80 of .*'other'"):
        scan_digests(read_parquet(stored))


@given(st.data())
def test_no_flipped_bit_of_recordings_is_believed(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("bits") / "p"
    write_parquet(from_arrays({"a": [samples(1)]}, CHANNELS, 0.01), folder)
    path = folder / "a@default.parquet"
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    try:
        found = read_parquet(folder).read(EpisodeKey("a", "default", "0"))
    except DataError:
        return
    np.testing.assert_array_equal(found, samples(1))


def test_files_elsewhere_are_not_read(stored: Path) -> None:
    index = stored / "population.json"
    content = json.loads(index.read_text())
    del content["checksum"]
    content["groups"][0]["file"] = f"../{stored.name}/a@default.parquet"
    index.write_text(json.dumps(content))
    with pytest.raises(DataError, match="not beside the index"):
        read_parquet(stored)


# ---------------------------------------------------------------------------------------- copies, stuck, periods
@pytest.mark.parametrize(
    "copied",
    [
        {("a", "c", "1"): 0, ("a", "c", "2"): 1, ("a", "c", "9"): 0, ("b", "c", "1"): 2},
        {("a", "c", "1"): 0, ("a", "c", "2"): 1, ("b", "c", "1"): 2, ("b", "c", "2"): 0},
        {("a", "c", "1"): 0, ("a", "c", "2"): 1, ("a", "d", "7"): 0, ("b", "c", "1"): 2},
    ],
    ids=["within a unit", "between units", "between conditions"],
)
def test_copies_are_refused_and_named(tmp_path: Path, copied: Any) -> None:
    data = {EpisodeKey(*place): samples(seed) for place, seed in copied.items()}
    population = from_arrays(data, CHANNELS, 0.01)
    with pytest.raises(DataError, match=r"[Ee]pisode \d of unit \w .* episode 1 of unit a \(c\)"):
        scan_digests(population)
    with pytest.raises(DataError, match=r"[Ee]pisode \d of unit \w .* episode 1 of unit a \(c\)"):
        write_parquet(population, tmp_path / "p")
    assert not (tmp_path / "p").exists()


def test_lines_before_the_header_are_counted_alike_whatever_they_hold(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b'made "on monday\nby, me\n' + GOOD)
    found = scan(tmp_path, skip_rows=2)
    assert found.read(found.episodes[0])[1, 0] == pytest.approx(np.sin(1), abs=1e-4)
