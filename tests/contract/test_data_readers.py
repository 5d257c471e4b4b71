"""Every reader gives the same population: raw layout, Parquet, CSV, arrays, a long frame."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kros.data import (
    Channel,
    EpisodeKey,
    Population,
    Role,
    from_arrays,
    from_frame,
    prepare,
    read,
    steps,
    write_parquet,
)
from kros.data.readers.motor_drive_raw import write_raw
from kros.plants.harmonic_drive.population import HarmonicDrivePopulation

PERIOD = 1e-3
CHANNELS = (
    Channel("position", Role.STATE, "rad", measured=True),
    Channel("velocity", Role.STATE, "rad/s"),
    Channel("current", Role.STATE, "1"),
    Channel("target_position", Role.INPUT, "rad"),
    Channel("target_velocity", Role.INPUT, "rad/s"),
)
NAMES = [c.name for c in CHANNELS]
KEYS = [EpisodeKey(u, c, e) for u in ("000003", "001011") for c in ("load", "noload") for e in ("0", "1")]
# What the raw reader declares and the others have to be told: calibration of the offset and the rest at the start.
PREPARATION = (steps.Offset("position", "target_position", 500, 1000), steps.Trim(start=1000))
MAPPING: dict[str, Any] = {
    "files": r"(?P<unit>\d{6})-(?P<condition>\w+)-(?P<episode>\d+)\.csv",
    "time": "time [ms]",
    "time_scale": 1e-3,
    "channel": [
        {"name": c.name, "column": c.name, "role": c.role.value, "unit": c.unit, "measured": c.measured, "scale": 1e-3}
        for c in CHANNELS[3:] + CHANNELS[:3]
    ],
}


def episode(key: EpisodeKey) -> np.ndarray:
    """One second at rest and a tenth of motion, on a grid that every format can write."""
    rng = np.random.default_rng(KEYS.index(key))
    target = np.concatenate([np.zeros(1000), np.linspace(0, 0.05, 101)])
    noise = 1e-4 * rng.standard_normal((1101, 3))
    return np.column_stack(
        [
            target - 0.02 + noise[:, 0],
            np.gradient(target, PERIOD) + noise[:, 1],
            0.1 + noise[:, 2],
            target,
            np.gradient(target, PERIOD),
        ]
    )


RAW = {key: episode(key) for key in KEYS}
ALIGNED = {key: values[:-1] for key, values in RAW.items()}  # the raw layout does not record the last target


def by_raw(folder: Path) -> Population:
    write_raw(from_arrays(RAW, CHANNELS, PERIOD), folder / "raw")
    return read(folder / "raw", "motor-drive-raw")


def by_parquet(folder: Path) -> Population:
    write_parquet(from_arrays(ALIGNED, CHANNELS, PERIOD), folder / "parquet")
    return prepare(read(folder / "parquet", "parquet"), PREPARATION)


def by_csv(folder: Path) -> Population:
    for key, values in ALIGNED.items():
        columns = [
            f"time [ms],{','.join(NAMES)}",
            *(f"{k},{','.join(repr(float(1e3 * v)) for v in row)}" for k, row in enumerate(values)),
        ]
        (folder / f"{key.unit}-{key.condition}-{key.episode}.csv").write_text("\n".join(columns))
    return read(folder, "csv", mapping=MAPPING, prepare=PREPARATION)


def by_arrays(folder: Path) -> Population:
    return prepare(from_arrays(ALIGNED, CHANNELS, PERIOD), PREPARATION)


def by_frame(folder: Path) -> Population:
    pd = pytest.importorskip("pandas")
    parts = [
        pd.DataFrame(v, columns=NAMES).assign(unit=k.unit, condition=k.condition, episode=int(k.episode))
        for k, v in ALIGNED.items()
    ]
    return prepare(from_frame(pd.concat(parts), CHANNELS, sample_period_s=PERIOD), PREPARATION)


READERS = {"raw": by_raw, "parquet": by_parquet, "csv": by_csv, "arrays": by_arrays, "frame": by_frame}


@pytest.mark.parametrize("opened", READERS.values(), ids=READERS.keys())
def test_same_population(opened: Callable[[Path], Population], tmp_path: Path) -> None:
    population = opened(tmp_path)
    assert population.channels == CHANNELS
    assert population.sample_period_s == PERIOD
    assert population.unit_ids == ("000003", "001011")
    assert population.conditions == ("load", "noload")
    assert list(population.episodes) == KEYS
    assert population.measured == ("position",)
    for key in KEYS:
        aligned = ALIGNED[key]
        expected = aligned[1000:].copy()
        expected[:, 0] += np.mean(aligned[500:1000, 3] - aligned[500:1000, 0])
        spoiled = population.read(key)
        spoiled.flags.writeable = True  # what a careless caller does to it never reaches the population
        spoiled[:] = 0.0
        values = population.read(key)
        assert values.dtype == np.float64
        # The raw layout rounds to 1e-6 deg, 1e-5 deg/s (motor side) and 1e-4 %.
        np.testing.assert_allclose(values, expected, rtol=1e-12, atol=1e-6 if opened is by_raw else 1e-15)
        np.testing.assert_allclose(
            values[:, [0, 1, 3, 4]], expected[:, [0, 1, 3, 4]], rtol=1e-12, atol=2e-9 if opened is by_raw else 1e-15
        )


@pytest.mark.parametrize("opened", READERS.values(), ids=READERS.keys())
def test_conversion_to_parquet_is_exact(opened: Callable[[Path], Population], tmp_path: Path) -> None:
    population = opened(tmp_path)
    write_parquet(population, tmp_path / "converted")
    converted = read(tmp_path / "converted", "parquet")
    assert (converted.channels, converted.units, converted.episodes) == (
        population.channels,
        population.units,
        population.episodes,
    )
    assert converted.metadata == population.metadata
    for key in KEYS:
        np.testing.assert_array_equal(converted.read(key), population.read(key))


def test_simulated_drives_come_back_from_the_raw_layout(tmp_path: Path) -> None:
    """The simulator prepares its population by its own code; the reader has to arrive at the same."""
    simulated = HarmonicDrivePopulation(n_units=2, n_episodes=2, seconds=3.0, outlier=True).simulate()
    write_raw(simulated.raw, tmp_path / "raw")
    back = read(tmp_path / "raw", "motor-drive-raw")
    expected = simulated.population
    assert (back.channels, back.units, back.episodes) == (expected.channels, expected.units, expected.episodes)
    assert (back.sample_period_s, dict(back.metadata)) == (expected.sample_period_s, dict(expected.metadata))
    for key in expected.episodes:
        worst = np.abs(back.read(key) - expected.read(key)).max(axis=0)
        assert np.all(worst < [1e-9, 1e-9, 1e-6, 1e-9, 1e-9])


def test_arrays_given_away_are_protected() -> None:
    mine = episode(KEYS[0])
    population = from_arrays({KEYS[0]: mine}, CHANNELS, PERIOD)
    with pytest.raises(ValueError, match="read-only"):
        population.read(KEYS[0])[0, 0] = 1.0
    mine[:] = 0.0
    np.testing.assert_array_equal(population.read(KEYS[0]), episode(KEYS[0]))
