"""Units of measure in headers and files, and episodes that columns cut out of a file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kros.core.errors import ConfigError, DataError
from kros.data.discovery.discover import Wanted, discover
from kros.data.measures import measure, unit_of_factor
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


OF_A_CHANNEL = {
    ("Body accel.", "g"): ("m/s^2", 9.80665, 0.0),
    ("beschleunigung_x", "mg"): ("m/s^2", 9.80665e-3, 0.0),
    ("Füllmenge", "g"): ("kg", 1e-3, 0.0),
    ("temp", "F"): ("K", 5 / 9, 459.67 * 5 / 9),
    ("Motor torque", "nm"): ("N m", 1.0, 0.0),
    ("gap", "nm"): ("m", 1e-9, 0.0),
}


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [("", *row) for row in SI.items()] + [(*key, row) for key, row in OF_A_CHANNEL.items()],
)
def test_si(name: str, text: str, expected: tuple[str, float, float]) -> None:
    found = measure(text, name)
    assert found is not None
    assert found.si == expected[0]
    assert (found.factor, found.offset) == pytest.approx(expected[1:], rel=1e-12)


NONE = ["", "%", "1", "counts", "dBm", "l/min", "foo", "9**9**9**9", "m/", "__import__('os')", "m^99", "x" * 10000]
NONE += [
    "pct",
    "pH",
    "Ah",
    "pu",
    "FS",
    "PS",
    "px",
    "S",
    "mS",
    "G",
    "NA",
    "ma",
]  # what pint reads as a unit of something else


@pytest.mark.parametrize("text", NONE)
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
        ("t [s],T [degC],i [V]", r"b_0\.csv: column 'i' is in 'V', and declared in 'mA'; correct the file, or column"),
        ("t [s],T [degC],i [foo]", "column 'i' is in 'foo', and declared in 'mA'"),
        ("t [s],T [%],i", r"column 'T \[degC\]' is in '%', and declared in 'degC'"),
        ("t [ms],T [degC],i,t [s]", "Expected 4 columns"),
    ],
)
def test_a_file_in_units_of_another_quantity_is_refused(tmp_path: Path, header: str, message: str) -> None:
    write(tmp_path / "b_0.csv", header, *signals(0))
    with pytest.raises(DataError, match=message):
        read_csv_folder(tmp_path, MAPPING)


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
    assert [(key.unit, key.episode) for key in found.episodes] == [("SN 7", "1"), ("SN 8", "1"), ("SN 8", "2")]
    np.testing.assert_allclose(found.read(found.episodes[2])[:, 0], temperature[40:] + 273.15)
    np.testing.assert_allclose(found.read(found.episodes[1])[:, 0], temperature[20:40] + 273.15)
    scattered = np.tile(["SN 7", "SN 8"], 30)
    write(tmp_path / "all.csv", "t [s],T [degC],i,serial,run", temperature, current, scattered, np.ones(N, int))
    with pytest.raises(DataError, match=r"Duplicate episodes: episode 1 of unit SN 7"):
        read_csv_folder(tmp_path, MAPPING | {"files": "all", "labels": {"unit": "serial", "episode": "run"}})
    with pytest.raises(ConfigError, match="labels"):
        read_csv_folder(tmp_path, MAPPING | {"labels": {"machine": "serial"}})
