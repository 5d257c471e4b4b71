"""The paper's raw layout, against files written line by line here."""

import math
from pathlib import Path

import numpy as np
import pytest

from kros.core.errors import DataError
from kros.data import EpisodeKey
from kros.data.readers.motor_drive_raw import read_motor_drive_raw

HEADER = "t,theta,omega,tau,theta_ref,omega_ref"
N = 1100
DEG = math.pi / 180 / 100


def truth(seed: int, n: int = N) -> np.ndarray:
    """Motor-side samples: time, position, velocity, torque, target position and velocity beside their measurements."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) * 1e-3
    moving = np.where(np.arange(n) >= 1000, time - 1.0, 0.0)
    target = 36000 * moving**2
    position = target - 12.5 + 0.01 * rng.standard_normal(n)
    velocity, torque = 72000 * moving + rng.standard_normal(n), rng.standard_normal(n)
    return np.column_stack([time, position, velocity, torque, target, 72000 * moving])


def write_file(path: Path, samples: np.ndarray, header: str = HEADER) -> Path:
    """Write one raw file as the bench does: targets one row late."""
    rows = samples.copy()
    rows[1:, 4:] = samples[:-1, 4:]
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [header, *(",".join(repr(float(v)) for v in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def folder(
    root: Path, serial: str, load: str = "noload", group: str = "population", stamp: str = "20220915T122400"
) -> Path:
    return root / "batch_b" / group / f"{stamp}_{serial}_{load}"


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """Two units and an outlier, two conditions, episodes 0 and 1."""
    for i, (serial, group) in enumerate([("001011", "population"), ("000002", "population"), ("000000", "outliers")]):
        for load in ("noload", "load"):
            for episode in (0, 1):
                write_file(folder(tmp_path, serial, load, group) / f"cycle_{episode:03d}.csv", truth(10 * i + episode))
    return tmp_path


def test_reads_values_units_and_facts(raw: Path) -> None:
    population = read_motor_drive_raw(raw)
    assert population.sample_period_s == 0.001
    groups = {"000000": "outliers", "000002": "population", "001011": "population"}
    assert {u.id: u.group for u in population.units} == groups
    assert population.conditions == ("load", "noload")
    assert population.states == ("position", "velocity", "current")
    assert population.inputs == ("target_position", "target_velocity")
    assert population.measured == ("position",)
    assert [c.unit for c in population.channels] == ["rad", "rad/s", "1", "rad", "rad/s"]
    assert dict(population.metadata) == {"plant": "harmonic-drive", "gear_ratio": 100}

    samples = truth(1)[:-1]  # the last target is not recorded
    offset = np.mean(samples[500:1000, 4] - samples[500:1000, 1])
    expected = (samples[:, 1:] + [offset, 0, 0, 0, 0]) * [DEG, DEG, 0.01, DEG, DEG]
    values = population.read(EpisodeKey("001011", "noload", "1"))
    np.testing.assert_allclose(values, expected[1000:], rtol=1e-13, atol=1e-15)


def test_two_time_stamps_add_up_unless_an_episode_is_in_both(raw: Path) -> None:
    again = folder(raw, "001011", stamp="20230101T000000")
    write_file(again / "cycle_002.csv", truth(5))
    assert [k.episode for k in read_motor_drive_raw(raw).keys("001011", "noload")] == ["0", "1", "2"]
    write_file(again / "cycle_001.csv", truth(6))
    with pytest.raises(DataError, match=r"Duplicate episodes: episode 1 of unit 001011 \(noload\).*remove one"):
        read_motor_drive_raw(raw)


def test_missing_header_line(raw: Path) -> None:
    path = folder(raw, "000002") / "cycle_001.csv"
    path.write_text("\n".join(path.read_text().splitlines()[1:]))
    with pytest.raises(DataError, match="one header line is needed"):
        read_motor_drive_raw(raw)


@pytest.mark.parametrize("per_second", [1e3, 1e6])
def test_time_in_milliseconds_or_microseconds(raw: Path, per_second: float) -> None:
    expected = read_motor_drive_raw(raw)
    values = [expected.read(key) for key in expected.episodes]
    for path in raw.rglob("*.csv"):
        samples = np.loadtxt(path, delimiter=",", skiprows=1)
        samples[:-1, 4:] = samples[1:, 4:]  # write_file makes them late again
        write_file(path, samples * [per_second, 1, 1, 1, 1, 1])
    found = read_motor_drive_raw(raw)
    assert found.sample_period_s == 0.001
    for key, value in zip(expected.episodes, values, strict=True):
        np.testing.assert_allclose(found.read(key), value, rtol=1e-12, atol=1e-15)


def test_names_that_do_not_fit(raw: Path) -> None:
    odd = write_file(folder(raw, "001011") / "cycle_x1.csv", truth(3))
    with pytest.raises(DataError, match=r"cycle_x1\.csv should be named .*_<episode>"):
        read_motor_drive_raw(raw)
    odd.unlink()
    write_file(raw / "batch_b" / "population" / "notes" / "cycle_001.csv", truth(3))
    with pytest.raises(DataError, match=r"notes/cycle_001\.csv should be named"):
        read_motor_drive_raw(raw)
