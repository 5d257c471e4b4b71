"""Units of measure in headers and files, and episodes that columns cut out of a file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kros.core.errors import ConfigError, DataError
from kros.data import EpisodeKey
from kros.data.discovery.discover import Wanted, discover
from kros.data.measures import measure, split_header, unit_of_factor
from kros.data.readers.csv_folder import read_csv_folder

SI = {
    "rpm": ("rad/s", math.pi / 30, 0.0),
    "1/min": ("rad/s", math.pi / 30, 0.0),
    "deg": ("rad", math.pi / 180, 0.0),
    "°/s": ("rad/s", math.pi / 180, 0.0),
    "bar": ("Pa", 1e5, 0.0),
    "[mA]": ("A", 1e-3, 0.0),
    "mV": ("V", 1e-3, 0.0),
    "mN": ("N", 1e-3, 0.0),
    "MN": ("N", 1e6, 0.0),
    "Nm": ("N m", 1.0, 0.0),
    "m/s2": ("m/s^2", 1.0, 0.0),
    "°C": ("K", 1.0, 273.15),
    "degF": ("K", 5 / 9, 459.67 * 5 / 9),
    "min": ("s", 60.0, 0.0),
    "Volts": ("V", 1.0, 0.0),
    "RPM": ("rad/s", math.pi / 30, 0.0),
}


@pytest.mark.parametrize("text", SI)
def test_si(text: str) -> None:
    found, (si, factor, offset) = measure(text), SI[text]
    assert found is not None
    assert found.si == si
    assert (found.factor, found.offset) == pytest.approx((factor, offset), rel=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "si", "factor"),
    [
        ("Body accel.", "g", "m/s^2", 9.80665),
        ("beschleunigung_x", "mg", "m/s^2", 9.80665e-3),
        ("Füllmenge", "g", "kg", 1e-3),
        ("temp", "F", "K", 5 / 9),
        ("Motor torque", "nm", "N m", 1.0),
        ("gap", "nm", "m", 1e-9),
    ],
)
def test_symbols_with_several_meanings_have_that_of_the_channel(name: str, text: str, si: str, factor: float) -> None:
    found = measure(text, name)
    assert found is not None
    assert (found.si, found.factor) == (si, pytest.approx(factor, rel=1e-9))


@pytest.mark.parametrize(
    "text", ["", "%", "1", "counts", "dBm", "l/min", "foo", "9**9**9**9", "m/", "__import__('os')", "m^99", "x" * 10000]
)
def test_what_is_not_converted(text: str) -> None:
    assert measure(text) is None


def test_names_of_factors() -> None:
    assert [unit_of_factor(*f) for f in ((math.pi / 30, "rad/s"), (1e-3, "A"), (math.pi, "rad"))] == ["rpm", "mA", ""]
    assert unit_of_factor(5 / 9, "K") == ""  # a degF has another zero


N = 60
TIME = 0.01 * np.arange(N)
MAPPING: dict[str, Any] = {
    "files": r"^(?P<unit>[a-z]+)_?(?P<episode>\d*)\.csv$",
    "time": "t [s]",
    "channel": [
        {"name": "T", "column": "T [degC]", "role": "state", "measured": True, "unit": "K", "offset": 273.15},
        {"name": "i", "column": "i", "column_unit": "mA", "role": "input", "unit": "A", "scale": 1e-3},
    ],
}


def write(path: Path, header: str, *columns: Any) -> None:
    rows = zip(TIME, *columns, strict=True)
    path.write_text("\n".join([header, *(",".join(str(x) for x in row) for row in rows)]) + "\n")


def signals(seed: int) -> tuple[np.ndarray, np.ndarray]:
    temperature, current = np.random.default_rng(seed).normal(size=(2, N)).round(6)
    return 20 + temperature, current


@pytest.mark.parametrize(
    ("header", "factors", "offset"),
    [
        ("t [s],T [degC],i", (1.0, 1.0), 0.0),
        ("t [s],T [K],i [A]", (1.0, 1e-3), 273.15),
        ("i_unused,t [s]\n,T (degF),i/A", (1.8, 1e-3), 32.0),
        ("t [s],T,i\n[s],[K],[mA]", (1.0, 1.0), 273.15),
    ],
)
def test_a_file_in_other_units_is_converted(tmp_path: Path, header: str, factors: Any, offset: float) -> None:
    values = {unit: signals(k) for k, unit in enumerate("ab")}
    write(tmp_path / "a_0.csv", "t [s],T [degC],i [mA]", *values["a"])
    header = header.replace("i_unused,t [s]\n", "t [s]")
    temperature, current = values["b"]
    write(tmp_path / "b_0.csv", header, temperature * factors[0] + offset, current * factors[1])
    mapping = MAPPING | {"unit_rows": 0} if "\n" not in header else MAPPING | {"files": "^(?P<unit>b)", "unit_rows": 1}
    found = read_csv_folder(tmp_path, mapping)
    expected = np.column_stack([temperature + 273.15, 1e-3 * current])
    np.testing.assert_allclose(found.read(found.keys("b")[0]), expected, rtol=1e-12)
    assert [c.unit for c in found.channels] == ["K", "A"]
    assert found.scaling["T"].offset == "273.15"


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (
            "t [s],T [degC],i [V]",
            r"b_0\.csv: column 'i' is in 'V', and declared in 'mA'; correct the file, or column_unit",
        ),
        ("t [s],T [degC],i [foo]", "column 'i' is in 'foo', and declared in 'mA'"),
        ("t [s],T [%],i", r"column 'T \[degC\]' is in '%', and declared in 'degC'"),
        ("t [ms],T [degC],i,t [s]", "Expected 4 columns"),
    ],
)
def test_a_file_in_units_of_another_quantity_is_refused(tmp_path: Path, header: str, message: str) -> None:
    write(tmp_path / "b_0.csv", header, *signals(0))
    with pytest.raises(DataError, match=message):
        read_csv_folder(tmp_path, MAPPING)


def test_init_writes_conversions_to_si(tmp_path: Path) -> None:
    for k, unit in enumerate(("motor1", "motor2")):
        for run in (1, 2):
            header = "time [ms],velocity [rpm],current (mA),T_degC,valve_cmd [%]" if run == 1 else "x"
            header = "time [ms],velocity [rad/s],current (A),T_degC,valve_cmd [%]" if header == "x" else header
            values = np.random.default_rng([k, run]).normal(size=(4, N))
            rows = zip(1e3 * TIME, *values, strict=True)
            (tmp_path / f"{unit}_run{run}.csv").write_text("\n".join([header, *(",".join(map(str, r)) for r in rows)]))
    found = discover(tmp_path, Wanted(measured=("velocity", "T")))
    channels = {c["name"]: c for c in found.mapping["channel"]}
    assert channels["velocity"]["unit"] == "rad/s"
    assert channels["T"] | {"role": "", "measured": True} == {
        "name": "T",
        "column": "T_degC",
        "column_unit": "degC",
        "role": "",
        "measured": True,
        "unit": "degC",
    }
    assert found.mapping["time"] == "time [ms]"
    assert "time_scale" not in found.mapping
    assert found.population.sample_period_s == pytest.approx(0.01)
    assert channels["valve_cmd"]["unit"] == "%"
    assert len(found.population.episodes) == 4
    speeds = [found.population.read(key)[:, 0] for key in found.population.episodes[:2]]
    raw = [np.random.default_rng([0, run]).normal(size=(4, N))[0] for run in (1, 2)]
    declared = channels["velocity"]["column_unit"]
    assert declared in ("rpm", "rad/s")
    np.testing.assert_allclose(speeds[0], raw[0] * math.pi / 30, rtol=1e-9)
    np.testing.assert_allclose(speeds[1], raw[1], rtol=1e-9)


def test_a_temperature_stays_in_degc_and_k(tmp_path: Path) -> None:
    measured = {"K": (1.0, 273.15), "degC": (1.0, 0.0), "degF": (1.8, 32.0)}
    for unit, (factor, zero) in measured.items():
        folder = tmp_path / unit
        folder.mkdir()
        for k in range(4):
            temperature, current = signals(k)
            write(folder / f"m{k // 2}_{k}.csv", f"t [s],T [{unit}],i_cmd [A]", factor * temperature + zero, current)
        found = discover(folder, Wanted(measured=("T",))).population
        added = 273.15 if unit == "K" else 0.0
        assert found.channels[0].unit == ("K" if unit == "K" else "degC")
        np.testing.assert_allclose(found.read(found.episodes[0])[:, 0], signals(0)[0] + added, rtol=1e-12)


# ------------------------------------------------------------------------------------- several episodes in one file
def test_columns_that_state_unit_and_episode(tmp_path: Path) -> None:
    temperature, current = signals(0)
    serial, run = np.repeat(["SN 7", "SN 8", "SN 8"], 20), np.repeat([1, 1, 2], 20)
    write(tmp_path / "all.csv", "t [s],T [degC],i,serial,run", temperature, current, serial, run)
    found = read_csv_folder(tmp_path, MAPPING | {"files": "all", "labels": {"unit": "serial", "episode": "run"}})
    assert found.episodes == tuple(
        EpisodeKey(u, "default", e) for u, e in (("SN 7", "1"), ("SN 8", "1"), ("SN 8", "2"))
    )
    np.testing.assert_allclose(found.read(found.episodes[2])[:, 0], temperature[40:] + 273.15)
    np.testing.assert_allclose(found.read(found.episodes[1])[:, 0], temperature[20:40] + 273.15)
    scattered = np.tile(["SN 7", "SN 8"], 30)
    write(tmp_path / "all.csv", "t [s],T [degC],i,serial,run", temperature, current, scattered, np.ones(N, int))
    with pytest.raises(DataError, match=r"Duplicate episodes: episode 1 of unit SN 7"):
        read_csv_folder(tmp_path, MAPPING | {"files": "all", "labels": {"unit": "serial", "episode": "run"}})
    with pytest.raises(ConfigError, match="labels"):
        read_csv_folder(tmp_path, MAPPING | {"labels": {"machine": "serial"}})


@pytest.mark.parametrize(("header", "unit"), [("time_min", "min"), ("t_h", "h"), ("Zeit_min", "min"), ("x_min", "")])
def test_a_column_of_time_may_be_in_minutes_or_hours(header, unit):
    assert split_header(header)[1] == unit


@pytest.mark.parametrize("text", ["pct", "pH", "Ah", "pu", "FS", "PS", "px", "S", "mS", "G", "NA", "ma"])
def test_what_pint_reads_as_a_unit_of_something_else_is_no_unit(text):
    assert measure(text) is None
