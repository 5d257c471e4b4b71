"""The CSV reader and its mapping."""

import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kros.core.errors import ConfigError, DataError
from kros.data import EpisodeKey, Population
from kros.data.readers import tables
from kros.data.readers.csv_folder import read_csv_folder

N = 50
CHANNEL: list[dict[str, Any]] = [
    {"name": "u", "column": "volt", "role": "input", "unit": "V"},
    {"name": "x", "column": "pos", "role": "state", "measured": True, "unit": "m", "scale": 1e-3},
]
MAPPING: dict[str, Any] = {
    "files": r"(?P<unit>[^/]+)/(?P<condition>\w+)_(?P<episode>\d+)\.csv",
    "time": "t",
    "channel": CHANNEL,
}


X = {"name": "x", "role": "state", "column": "pos"}


def samples(seed: int) -> np.ndarray:
    """Columns t, pos, volt."""
    rng = np.random.default_rng(seed)
    return np.column_stack([np.arange(N) * 0.01, rng.standard_normal((N, 2))])


def write(path: Path, values: np.ndarray, header: str = "t,pos,volt\n", delimiter: str = ",", end: str = "\n") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    text = header + "".join(delimiter.join(repr(float(v)) for v in row) + end for row in values)
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())


def mapping(**changes: Any) -> dict[str, Any]:
    return {**MAPPING, **changes}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for seed, name in enumerate(["a/cold_1", "a/cold_2", "b/cold_1", "b/cold_10", "b/cold_2", "b/warm_1"]):
        write(tmp_path / f"{name}.csv", samples(seed))
    (tmp_path / "notes.csv.bak").write_text("nothing")
    return tmp_path


def test_values_keys_and_channels(folder: Path) -> None:
    population = read_csv_folder(folder, MAPPING)
    assert [str(k) for k in population.keys("b")] == [
        f"episode {e} of unit b ({c})" for c, e in [("cold", 1), ("cold", 2), ("cold", 10), ("warm", 1)]
    ]
    assert (population.states, population.inputs, population.measured) == (("x",), ("u",), ("x",))
    assert population.sample_period_s == 0.01
    values = population.read(EpisodeKey("a", "cold", "2"))
    np.testing.assert_allclose(values, samples(1)[:, 1:] * [1e-3, 1], rtol=1e-15)


def test_several_units_in_one_file(tmp_path: Path) -> None:
    values = np.column_stack([samples(0), samples(1)[:, 1:]])
    write(tmp_path / "rig_1.csv.gz", values, "t,pos1,volt1,pos2,volt2\n")
    units = [{"suffix": f"/joint{j}", "columns": {"x": f"pos{j}", "u": f"volt{j}"}} for j in (1, 2)]
    channel = [{k: v for k, v in c.items() if k not in ("column", "scale")} for c in CHANNEL]
    population = read_csv_folder(tmp_path, mapping(files=r"(?P<unit>\w+)_(?P<episode>\d)", channel=channel, unit=units))
    assert population.unit_ids == ("rig/joint1", "rig/joint2")
    np.testing.assert_allclose(population.read(EpisodeKey("rig/joint2", "default", "1")), values[:, 3:], rtol=1e-15)


def test_tab_separated_without_header(tmp_path: Path) -> None:
    values = samples(0)
    values[:, 0] *= 1000
    write(tmp_path / "a_1.tsv", values, "", "\t", "\r\n")
    channel = [{**CHANNEL[0], "column": 3}, {**CHANNEL[1], "column": 2}]
    table = mapping(
        files=r"(?P<unit>a)_(?P<episode>\d)", channel=channel, time=1, time_scale=1e-3, header=False, delimiter="\t"
    )
    population = read_csv_folder(tmp_path, table)
    assert population.sample_period_s == 0.01
    np.testing.assert_allclose(population.read(population.episodes[0]), values[:, 1:] * [1e-3, 1], rtol=1e-15)
    table["channel"] = [{**CHANNEL[0], "column": 4}, channel[1]]
    with pytest.raises(DataError, match=r"a_1\.tsv: column 4 is missing; found .*; correct the mapping"):
        read_csv_folder(tmp_path, table)


def read_first(folder: Path, unit: str = "a") -> Population:
    population = read_csv_folder(folder, MAPPING)
    population.read(EpisodeKey(unit, "cold", "1"))
    return population


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("0.5,1,2,3", r"cold_1\.csv: .*Expected 3 columns, got 4"),
        ("0.5,1", r"cold_1\.csv: .*Expected 3 columns, got 2"),
        ("0.5,1,off", r"cold_1\.csv: in column 'volt'.*'off'"),
        ("0.5,,1", r"Episode 1 of unit a \(cold\): channel 'x' has 1 NaN at sample 50"),
        ("0.5,1,inf", "channel 'u' has 1 infinity at sample 50"),
        ("0.505,1,1", r"uneven time, .* 0\.015 s at sample 49"),
    ],
)
def test_bad_rows(folder: Path, row: str, message: str) -> None:
    path = folder / "a" / "cold_1.csv"
    path.write_text(path.read_text() + row + "\n")
    with pytest.raises(DataError, match=message):
        read_first(folder)


def test_duplicates_and_no_match(folder: Path) -> None:
    with pytest.raises(DataError, match=r"Duplicate episodes: episode 1 of unit b \(default\)"):
        read_csv_folder(folder, mapping(files=r"(?P<unit>[^/]+)/\w+_(?P<episode>\d+)\.csv"))
    match = r"no file matches files = 'run\\\\d', there are 6 files such as 'a/cold_1\.csv'"
    with pytest.raises(DataError, match=match):
        read_csv_folder(folder, mapping(files=r"run\d"))


def test_another_rate(folder: Path) -> None:
    write(folder / "b" / "cold_1.csv", samples(0) * [2, 1, 1])
    match = r"unit b \(cold\).* not the 0\.01 s of episode 1 of unit a \(cold\): found steps of 0\.02 s"
    with pytest.raises(DataError, match=match):
        read_first(folder, "b")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"file": "x"}, r"file: unknown key; did you mean 'files'\? known are .*files, channel, time"),
        (
            {"channel": [X | {"measurd": True}]},
            r"channel\.0\.measurd: unknown key; did you mean 'measured'\? .* offset, of\.",
        ),
        ({"channel": [X | {"role": "output"}]}, r"role: input should be 'state', 'input' or 'truth', found 'output'"),
        ({"channel": []}, r"there is no \[\[channel\]\]"),
        ({"files": "(?P<Unit>.)"}, "files: names the group 'Unit'; known groups are unit, .*, found '[(][?]P<Unit>"),
        (
            {"channel": [X, X | {"name": "y"}]},
            r"mapping: every channel needs a column of its own, found \['pos', 'pos'\]",
        ),
        ({"files": "("}, r"files: input is not a regular expression .*, found '\('"),
        ({"time": None}, "one of time and sample_period_s"),
        ({"time": 0}, "greater than or equal to 1, found 0"),
        ({"header": False}, "leaves columns without names, found 't'"),
        ({"delimiter": "::"}, "two different characters .* found delimiter = '::'"),
        ({"decimal": ","}, "two different characters"),
        ({"skip_rows": -1}, "skip_rows: input should be greater than or equal to 0, found -1"),
        ({"unit": [{"suffix": "1", "columns": {"z": "pos"}}]}, r"gives a column for 'z'; channels are \['u', 'x'\]"),
    ],
)
def test_mapping_refuses(folder: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_csv_folder(folder, mapping(**changes))


def test_one_unit_in_two_groups(tmp_path: Path) -> None:
    for name in ("good/a_1.csv", "outliers/a_2.csv"):
        write(tmp_path / name, samples(0))
    with pytest.raises(DataError, match="Unit a is in both groups 'good' and 'outliers'"):
        read_csv_folder(tmp_path, mapping(files=r"(?P<group>\w+)/(?P<unit>a)_(?P<episode>\d)"))


def test_an_episode_of_a_file_with_several_is_left_out_by_its_name(tmp_path: Path) -> None:
    rows = [f"{run},{0.1 * k:.1f},{k},{k * k}" for run in (1, 2, 3) for k in range(5)]
    (tmp_path / "a.csv").write_text("\n".join(["run,t,pos,volt", *rows]))
    given = {"files": "(?P<unit>a)", "labels": {"episode": "run"}}
    episodes = {text: read_csv_folder(tmp_path, mapping(**given, exclude=text)).episodes for text in ("#a/.*/2$", "b")}
    assert [[key.episode for key in keys] for keys in episodes.values()] == [["1", "3"], ["1", "2", "3"]]


def test_pieces_are_the_recording_in_parts(tmp_path: Path) -> None:
    write(tmp_path / "a.csv", samples(0))
    whole = read_csv_folder(tmp_path, mapping(files="(?P<unit>a)"))
    parts = read_csv_folder(tmp_path, mapping(files="(?P<unit>a)", pieces=3))
    assert [k.episode for k in parts.episodes] == ["0.1", "0.2", "0.3"]
    np.testing.assert_array_equal(
        np.concatenate([parts.read(k) for k in parts.episodes]), whole.read(whole.episodes[0])
    )
    write(tmp_path / "a.csv", samples(1))
    np.testing.assert_allclose(parts.read(parts.episodes[0])[:, 1], samples(1)[:16, 2])


@pytest.mark.parametrize(
    "text",
    ["31.12.2023 23:59:59,5", "2023-12-31T23:59:59.500Z", "12/31/2023 23:59:59.5", "2023-12-31T23:59:59.500+01:00"],
)
def test_timestamps_over_the_turn_of_a_year(tmp_path: Path, text: str) -> None:
    order = {"3": "dmy", "2": "ymd", "1": "mdy"}[text[0]]
    turned = {"dmy": "01.01.2024 00:00:00,", "ymd": "2024-01-01T00:00:00.", "mdy": "01/01/2024 00:00:00."}[order]
    zone = text[23:] if order == "ymd" else ""
    rows = [f"{text};1;2", *(f"{turned}{5 * k}{zone};{k};{k * k}" for k in range(2))]
    (tmp_path / "a.csv").write_text("\n".join(["t;pos;volt", *rows]))
    population = read_csv_folder(tmp_path, mapping(files="a", delimiter=";", timestamp=order))
    assert population.sample_period_s == 0.5
    assert population.read(population.episodes[0]).shape == (3, 2)


@pytest.mark.parametrize(("time", "scale"), [("t", {"time_scale": 1e-3}), ("t [ms]", {})])
def test_milliseconds_since_1970_lose_nothing(tmp_path: Path, time: str, scale: dict[str, float]) -> None:
    rows = [f"{1716000000000 + 2 * k},{k},{k * k}" for k in range(9)]
    (tmp_path / "a.csv").write_text("\n".join([f"{time},pos,volt", *rows]))
    assert read_csv_folder(tmp_path, mapping(files="a", **scale)).sample_period_s == 0.002


def test_a_long_file_of_which_some_rows_are_written_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "BLOCK", 1 << 12)
    values = np.column_stack([np.arange(2000) * 0.01, np.random.default_rng(0).standard_normal((2000, 2))])
    write(tmp_path / "a_1.csv", np.repeat(values, 1 + (np.arange(2000) % 100 == 7), axis=0))  # some are written twice
    population = read_csv_folder(tmp_path, mapping(files=r"(?P<unit>a)_(?P<episode>\d)", sample_period_s=None))
    (key,) = population.episodes
    np.testing.assert_allclose(population.read(key) * [1000, 1], values[:, 1:], rtol=1e-9)  # mm are read as m


def test_time_is_converted_file_by_file_as_other_columns_are(tmp_path: Path) -> None:
    plain = samples(0)
    for name, unit, factor in (("a/cold_1.csv", "s", 1.0), ("a/cold_2.csv", "ms", 1e3)):
        write(tmp_path / name, (plain + np.array([0, factor, 0])) * [factor, 1, 1], f"t,pos,volt\n{unit},mm,V\n")
    one = read_csv_folder(tmp_path, mapping(unit_rows=1))
    assert one.sample_period_s == 0.01
    assert [len(one.read(key)) for key in one.episodes] == [N, N]
    with pytest.raises(DataError, match=r"cold_2\.csv: column 't' is in 'ms', and in another file in 's'"):
        read_csv_folder(tmp_path, mapping(time_scale=1.0, unit_rows=1))
    for name, unit in (("a/cold_1.csv", "seconds"), ("a/cold_2.csv", "s")):  # one unit, in two spellings
        write(tmp_path / name, plain + np.array([0, len(unit), 0]), f"t,pos,volt\n{unit},counts,V\n")
    assert read_csv_folder(tmp_path, mapping(unit_rows=1)).sample_period_s == 0.01
    assert read_csv_folder(tmp_path, mapping(time_scale=1e-3, unit_rows=1)).sample_period_s == 1e-5
    write(tmp_path / "a/cold_1.csv", plain, "t,pos,volt\nrad,counts,V\n")
    with pytest.raises(DataError, match=r"column 't' is in 'rad', and declared in 's'"):
        read_csv_folder(tmp_path, mapping(unit_rows=1))


def test_a_damaged_first_file_gives_no_period_and_spoils_no_other(folder: Path) -> None:
    (folder / "a/cold_1.csv").write_text("t,pos,volt\n0.0,1,2\n0.01,1\n")
    population = read_csv_folder(folder, MAPPING)
    assert population.sample_period_s == 0.01
    with pytest.raises(DataError, match=r"cold_1\.csv: CSV parse error"):
        population.read(population.episodes[0])
    assert population.read(population.episodes[1]).shape == (N, 2)


def test_an_optional_channel_in_another_unit_is_converted_and_not_absent(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x [m],v [mm/s],u\n" + "".join(f"{k},{1000 * k},0\n" for k in range(5)))
    channels = [
        {"name": "x", "column": "x [m]", "role": "state", "measured": True},
        {"name": "v", "column": "v [m/s]", "role": "state"},
        {"name": "w", "column": "w [m/s]", "role": "state"},
        {"name": "u", "role": "input"},
    ]
    described = {"files": r"(?P<unit>\w)\.csv", "sample_period_s": 0.1, "channel": channels}
    found = read_csv_folder(tmp_path, described, optional=["v", "w"])
    assert found.states == ("x", "v")
    np.testing.assert_allclose(found.read(found.keys()[0])[:, 1], range(5))
