"""`kros init` on folders of many kinds: dialects, oddities of spreadsheets, names in two languages."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from csvs import write_csvs

from kros.data import EpisodeKey, Population
from kros.plants import DcMotorPopulation
from kros.study import load_config
from kros.study.stages.learning import open_source

Array = np.ndarray
DEGREE = np.pi / 180


@pytest.fixture(scope="module")
def motors() -> Population:
    """DC motors: position, velocity, current, voltage."""
    return DcMotorPopulation(n_units=4, n_episodes=3, seconds=2, seed=3).simulate().population


def comma(value: float) -> str:
    return f"{value:.12g}".replace(".", ",")


def european(path: Path, values: Array, period_s: float) -> None:
    """Semicolons, decimal commas, latin-1, units in a second row, milliseconds, degrees, CR LF."""
    rows = np.column_stack([1e3 * period_s * np.arange(len(values)), values / [DEGREE, np.pi / 30, 1, 1]])
    lines = [
        "Zeit;Winkel Abtrieb;Drehzahl;Strom;Spannung (Klemmen)",
        "ms;°;1/min;A;V",
        *(";".join(map(comma, r)) for r in rows.tolist()),
    ]
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode("latin-1"))


def spreadsheet(path: Path, values: Array, period_s: float) -> None:
    """A mark at the start, a title, quoted headers, semicolons behind the numbers, timestamps, an empty line."""
    clock = [f"31.05.2024 12:00:{k * period_s:06.3f}".replace(".", ",") for k in range(len(values))]
    clock = [f"31.05.2024{c[10:]}" for c in clock]
    lines = ["Prüfstand 4;;;;", "", '"Uhrzeit";"Position [rad]";"Speed; motor [rad/s]";"Current [A]";"Voltage [V]"']
    lines += [";".join([t, *map(comma, r)]) + ";" for t, r in zip(clock, values.tolist(), strict=True)]
    path.write_text("\ufeff" + "\n".join(lines) + "\n", encoding="utf-8")


def tabs(path: Path, values: Array, period_s: float) -> None:
    """UTF-16 with tabs, as spreadsheets write text; seconds in a column that counts from an hour."""
    rows = np.column_stack([3600 + period_s * np.arange(len(values)), values])
    lines = ["time\tpos_rad\tspeed (rad/s)\tcurrent in A\tu/V", *("\t".join(f"{x:.12g}" for x in r) for r in rows)]
    path.write_text("\n".join(lines), encoding="utf-16")


def plain(path: Path, values: Array, period_s: float) -> None:
    """Commas and points, lines that end with CR; a counter, a column that rests, a note."""
    lines = ["index,time_us,position,velocity,current,voltage,spare,note"]
    rows = (",".join(f"{x:.12g}" for x in row) for row in values.tolist())
    lines += [f"{k},{1e6 * k * period_s:.6g},{row},0.5,fine" for k, row in enumerate(rows)]
    path.write_bytes(("\r".join(lines) + "\r").encode())


WRITERS: dict[str, tuple[Callable[[Path, Array, float], None], str]] = {
    "european": (european, "Antrieb {unit}/Leerlauf_Messung_{episode}.csv"),
    "spreadsheet": (spreadsheet, "motor{unit}_run{episode}.CSV"),
    "tabs": (tabs, "SN10{unit}-{episode}.txt"),
    "plain": (plain, "{unit}/2024-05-0{episode}.csv"),
}


def written(folder: Path, population: Population, kind: str) -> Path:
    """Write all episodes as a stranger would."""
    write, name = WRITERS[kind]
    for key in population.episodes:
        path = folder / name.format(unit=int(key.unit), episode=int(key.episode) + 1)
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, population.read(key), population.sample_period_s)
    return folder


@pytest.mark.parametrize("kind", list(WRITERS))
def test_every_dialect_is_read_back_as_it_was_written(kros, tmp_path, motors, kind):
    folder, study = written(tmp_path / "recordings", motors, kind), tmp_path / "study.toml"
    result = kros("init", folder, "--out", study)
    assert result.exit_code == 0, result.output
    found = open_source(load_config(study))
    assert len(found.unit_ids) == 4
    assert [len(keys) for _, _, keys in found.groups()] == [3] * 4
    assert found.sample_period_s == pytest.approx(motors.sample_period_s, rel=1e-9)
    assert (len(found.measured), len(found.states), len(found.inputs)) == (1, 3, 1)
    for ours, theirs in zip(found.episodes, motors.episodes, strict=True):
        np.testing.assert_allclose(found.read(ours), motors.read(theirs), rtol=1e-8, atol=1e-10)


def test_what_is_wrong_is_said_and_left_out_before_anything_is_computed(kros, tmp_path, motors):
    folder, study = written(tmp_path / "recordings", motors, "plain"), tmp_path / "study.toml"
    units = sorted(p.name for p in folder.iterdir())
    shutil.copy(folder / units[0] / "2024-05-01.csv", folder / units[1] / "2024-05-01.csv")
    stuck = folder / units[2] / "2024-05-02.csv"
    head, *lines = (line.split(",") for line in stuck.read_text().splitlines())
    stuck.write_text("\n".join(map(",".join, [head, *([*row[:4], "1.5", *row[5:]] for row in lines)])))
    gap = folder / units[3] / "2024-05-03.csv"
    lines = gap.read_text().splitlines()
    gap.write_text("\n".join(lines[:500] + lines[600:]))
    (folder / "notes.csv").write_text("who,when\nme,today\n")
    result = kros("init", folder, "--out", study)
    assert result.exit_code == 0, result.output
    for part in (
        "a copy of episode",
        "'current' stays at 1.5 in all ",
        "the worst step differs by 0.2 s at sample 498 of",
        "1 files are not like the others and left alone: notes.csv",
    ):
        assert part in result.output
    found = open_source(load_config(study))
    assert len(found.episodes) == 10
    assert not {EpisodeKey(unit, "default", "01") for unit in units[:2]} <= set(found.episodes)
    assert kros("run", study, "--out", tmp_path / "run", "--until", "read").exit_code == 0
    for change, message in (
        ("time_scale=nan", "data.csv.time_scale: input should be a finite number, found nan"),
        ("encoding=utf-16", "not UTF-16 (UTF-16 stream does not start with BOM)"),
        ("pieces=100000", "pieces: input should be less than or equal to 1000, found 100000"),
    ):
        result = kros("run", study, "--out", tmp_path / "no", "--until", "read", "--set", f"data.csv.{change}")
        assert (result.exit_code, message in result.stderr) == (2, True), result.stderr


def test_roles_are_taken_from_options(kros, tmp_path, motors):
    folder = write_csvs(tmp_path / "recordings", motors, "{key.unit}_{key.episode}.csv", "aa,bb,cc,dd", count=6)
    study = tmp_path / "study.toml"

    def refused(words: str, *options: object) -> None:
        result = kros("init", folder, "--out", study, *options)
        assert result.exit_code == 2
        assert words in result.output

    period, roles = ("--period", 0.002), ("--measured", "aa", "--input", "dd")
    refused("--period SECONDS")
    name = "no column is a measured state by its name; name it, --measured NAME. The columns are aa, bb, cc, dd"
    refused(name, *period)
    refused("there is no column 'd'", *period, "--measured", "aa", "--input", "d")
    refused("--measured and --input both name 'aa'", *period, "--measured", "aa", "--input", "aa")
    refused("sample_period_s: input should be greater than 0, found 0.0", "--period", 0, *roles)
    result = kros("init", folder, "--out", study, *period, *roles)
    assert result.exit_code == 0, result.output
    found = open_source(load_config(study))
    assert (found.measured, found.states, found.inputs) == (("aa",), ("aa", "bb", "cc"), ("dd",))
    before = study.read_bytes()
    refused("exists; name another file", *period, *roles)
    assert study.read_bytes() == before


def test_columns_of_one_name_are_told_apart_and_reserved_names_are_not_taken(kros, tmp_path, motors):
    def folder(name: str, header: str) -> Path:
        return write_csvs(tmp_path / name, motors, "{key.unit}/run_{key.episode}.csv", header, count=6)

    doubled, key = folder("doubled", "time,position,velocity,velocity,u"), motors.episodes[0]
    named = kros("init", doubled, "--out", tmp_path / "none.toml", "--measured", "time")
    assert "no column 'time'; beside time there are position, velocity, velocity_2 ('velocity'), u" in named.stderr
    result = kros("init", doubled, "--out", tmp_path / "study.toml")
    assert result.exit_code == 0, result.output
    found = open_source(load_config(tmp_path / "study.toml"))
    np.testing.assert_allclose(found.read(key)[:, 2], motors.read(key)[:, 2])
    reserved, both = folder("reserved", "time,k,unit,current,u"), ("--measured", "k", "--measured", "unit")
    assert kros("init", reserved, "--out", tmp_path / "reserved.toml", *both).exit_code == 0
    assert open_source(load_config(tmp_path / "reserved.toml")).states == ("k_2", "unit_2", "current")


def test_single_samples_without_a_value_cost_no_episode(kros, tmp_path, motors):
    def with_gap(values: Array, number: int) -> Array:
        table = values.copy()
        table[100 + number, 1] = np.nan
        if number == 0:
            table[:, 2] = np.nan  # nothing to bridge: the episode cannot be used
        return table

    header = "time,position,velocity,current,voltage"
    recordings = write_csvs(tmp_path / "recordings", motors, "{key.unit}_{key.episode}.csv", header, with_gap)
    result = kros("init", recordings, "--out", tmp_path / "study.toml")
    assert result.exit_code == 0, result.output
    assert f"NaN in {len(motors.episodes) - 1} episodes is bridged by straight lines" in result.output
    assert "left out, " in result.output
    assert "would refuse" not in result.output
    found = open_source(load_config(tmp_path / "study.toml"))
    whole = np.array([found.read(key) for key in found.episodes])
    np.testing.assert_allclose(whole, [motors.read(k) for k in motors.episodes[1:]], atol=2e-2 * np.abs(whole).max())
