"""Raw CSV to native Parquet and back; 39 units x 2 conditions x 20 episodes x 20 s at 1 kHz (1.8 GB of CSV) with KROS_BENCH_UNITS=39."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kros.data import EpisodeKey, Population, Unit, read, write_parquet, write_raw
from kros.plants.harmonic_drive.population import HarmonicDrivePopulation

UNITS = int(os.environ.get("KROS_BENCH_UNITS", "4"))
EPISODES = 20


@dataclass(frozen=True, eq=False)
class Repeated:
    """A few simulated episodes over and over, under many names."""

    episodes: tuple[np.ndarray, ...]

    def __call__(self, key: EpisodeKey) -> np.ndarray:
        return self.episodes[(int(key.unit) + int(key.episode) + len(key.condition)) % len(self.episodes)]


@pytest.fixture(scope="module")
def drives() -> Population:
    """Simulated drives as recorded."""
    raw = HarmonicDrivePopulation(n_units=2, n_episodes=5, seconds=19.0).simulate().raw
    source = Repeated(tuple(raw.read(key) for key in raw.episodes))
    keys = tuple(EpisodeKey(f"{u:06d}", c, str(e)) for u in range(UNITS) for c in ("load", "noload") for e in range(EPISODES))
    units = tuple(Unit(f"{u:06d}", "population") for u in range(UNITS))
    return Population(raw.channels, raw.sample_period_s, units, keys, source, raw.metadata)


@pytest.fixture(scope="module")
def folder(drives: Population, tmp_path_factory: pytest.TempPathFactory) -> Any:
    root = tmp_path_factory.mktemp("bench")
    write_raw(drives, root / "raw")
    write_parquet(read(root / "raw", "motor-drive-raw"), root / "parquet")
    yield root
    shutil.rmtree(root)


def test_write_raw(benchmark: Any, drives: Population, tmp_path: Path) -> None:
    benchmark.pedantic(write_raw, args=(drives, tmp_path / "raw"), kwargs={"overwrite": True}, rounds=2)
    assert len(list((tmp_path / "raw").rglob("*.csv"))) == len(drives.episodes)
    shutil.rmtree(tmp_path / "raw")


def test_open_raw(benchmark: Any, folder: Path) -> None:
    population = benchmark(read, folder / "raw", "motor-drive-raw")
    assert len(population.episodes) == UNITS * 2 * EPISODES


def test_convert_raw_to_parquet(benchmark: Any, folder: Path, tmp_path: Path) -> None:
    population = read(folder / "raw", "motor-drive-raw")
    benchmark.pedantic(write_parquet, args=(population, tmp_path / "out"), kwargs={"overwrite": True}, rounds=2)
    converted = read(tmp_path / "out", "parquet")
    for key in population.episodes[::37]:
        np.testing.assert_array_equal(converted.read(key), population.read(key))
    shutil.rmtree(tmp_path / "out")


def test_read_parquet(benchmark: Any, folder: Path) -> None:
    def read_all() -> int:
        population = read(folder / "parquet", "parquet")
        return sum(len(population.read(key)) for key in population.episodes)

    assert benchmark(read_all) == UNITS * 2 * EPISODES * 19_000
