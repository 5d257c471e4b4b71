"""Write a population of motor drives in the paper's raw layout: the inverse of `readers.motor_drive_raw`."""

from __future__ import annotations

import io
import re
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ..arrow import from_numpy
from ..population import OUTLIERS, EpisodeKey, Population
from ..readers.motor_drive_raw import CHANNELS, MOTOR_DEG_TO_RAD, PERCENT, TARGET_LAG
from .folders import in_threads, whole_folder

HEADER = b"time_s,position_deg,velocity_deg_per_s,torque_percent,target_position_deg,target_velocity_deg_per_s\n"
DECIMALS = (6, 6, 5, 4, 6, 5)  # time, position, velocity, torque, target position, target velocity
FIRST_STAMP = datetime(2023, 1, 1)


def write_raw(population: Population, out: Path | str) -> None:
    """Write the paper's raw layout, ``<out>/batch_b/<group>/<stamp>_<serial>_<load|noload>/*_<episode>.csv``.

    Parameters
    ----------
    population : Population
        Drives *before* preparation, in the reader's channels and units (rad and rad/s at the gear output, fraction of
        full scale): episodes still hold the 1000 samples at rest and the offset of the position. Targets are written
        one row later than the measurements they belong to, so reading back gives one sample less (and 1000 less at
        rest).
    out : Path
        Folder to make, whole or not at all.

    Raises
    ------
    DataError
        Other channels, or names that the layout cannot hold.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from kros.data import write_raw
    >>> from kros.plants import HarmonicDrivePopulation
    >>> drives = HarmonicDrivePopulation(n_units=2, n_episodes=1, seconds=2.0, conditions=("noload",))
    >>> with TemporaryDirectory() as folder:
    ...     write_raw(drives.simulate().raw, f"{folder}/raw")  # as recorded, before preparation
    ...     print(len(list(Path(folder).rglob("*.csv"))))
    2
    """
    names, expected = tuple(c.name for c in population.channels), tuple(c.name for c in CHANNELS)
    if names != expected:
        needs = f"needs the channels {expected}, found {names}"
        raise DataError(f"Writing the raw layout of motor drives {needs}; write Parquet instead.")
    groups = list(population.groups())
    for key in population.episodes:
        _check_names(key)
    with whole_folder(Path(out)) as folder:
        in_threads([partial(_write_folder, population, keys, folder, i) for i, (_, _, keys) in enumerate(groups)])


def _check_names(key: EpisodeKey) -> None:
    """Refuse names that the layout cannot hold."""
    named = re.fullmatch("[0-9]{6}", key.unit) and re.fullmatch("[0-9]{1,3}", key.episode)
    if not named or key.condition not in ("load", "noload"):
        needs = "needs a unit of six digits, a condition load or noload and an episode below 1000"
        raise DataError(f"Writing the raw layout: {needs}, found {key}; rename it or write Parquet instead.")


def _write_folder(population: Population, keys: tuple[EpisodeKey, ...], folder: Path, index: int) -> None:
    """Write the episodes of one unit and condition."""
    unit, condition = keys[0].unit, keys[0].condition
    group = OUTLIERS if population.unit(unit).group == OUTLIERS else "population"
    stamp = (FIRST_STAMP + timedelta(minutes=10 * index)).strftime("%Y%m%dT%H%M%S")
    name = f"{stamp}_{unit}_{condition}"
    target = folder / "batch_b" / group / name
    target.mkdir(parents=True)
    for key in keys:
        content = raw_csv(population.read(key), population.sample_period_s)
        (target / f"{name}_{int(key.episode):03d}.csv").write_bytes(content)


def raw_csv(values: npt.NDArray[np.float64], sample_period_s: float) -> bytes:
    """Return one raw file."""
    import pyarrow as pa
    from pyarrow import csv

    recorded = values.copy()
    recorded[TARGET_LAG:, 3:] = values[:-TARGET_LAG, 3:]
    recorded[:TARGET_LAG, 3:] = values[0, 3:]
    recorded /= np.array([MOTOR_DEG_TO_RAD, MOTOR_DEG_TO_RAD, PERCENT, MOTOR_DEG_TO_RAD, MOTOR_DEG_TO_RAD])
    columns = zip([np.arange(len(values)) * sample_period_s, *recorded.T], DECIMALS, strict=True)
    rounded = [from_numpy(np.round(column, decimals) + 0.0) for column, decimals in columns]
    table = pa.Table.from_arrays(rounded, names=[c.name for c in CHANNELS] + ["time"])
    buffer = io.BytesIO(HEADER)
    buffer.seek(len(HEADER))
    csv.write_csv(table, buffer, csv.WriteOptions(include_header=False))
    return buffer.getvalue()
