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
    """Write the paper's raw layout, ``<out>/batch_b/{population,outliers}/<stamp>_<serial>_<load|noload>/<stamp>_<episode>.csv``.

    Parameters
    ----------
    population : Population
        Drives *before* preparation, in the reader's channels and units (rad and rad/s at the gear output, fraction of full scale): episodes
        still hold the 1000 samples at rest and the offset of the position; targets stand beside the measurements they belong to.
        Each file holds as many samples as the episode; targets are written one row later, so the last one is not recorded and reading back
        gives one sample less (and 1000 less at rest).
    out : Path
        Folder to make, whole or not at all.

    Raises
    ------
    DataError
        Other channels, serials that are not six digits, conditions other than load and noload, episodes that are not numbers below 1000.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from kros.data import write_raw
    >>> from kros.plants import HarmonicDrivePopulation
    >>> simulated = HarmonicDrivePopulation(n_units=2, n_episodes=1, seconds=2.0, conditions=("noload",)).simulate()
    >>> with TemporaryDirectory() as folder:
    ...     write_raw(simulated.raw, f"{folder}/raw")  # as recorded, before preparation
    ...     print(len(list(Path(folder).rglob("*.csv"))))
    2
    """
    names = tuple(c.name for c in population.channels)
    expected = tuple(c.name for c in CHANNELS)
    if names != expected:
        raise DataError(
            f"Writing the raw layout of motor drives needs the channels {expected}, found {names}; write Parquet instead."
        )
    groups = list(population.groups())
    for _, _, keys in groups:
        for key in keys:
            _check_names(key)
    with whole_folder(Path(out)) as folder:
        in_threads([partial(_write_folder, population, keys, folder, i) for i, (_, _, keys) in enumerate(groups)])


def _check_names(key: EpisodeKey) -> None:
    if (
        not re.fullmatch("[0-9]{6}", key.unit)
        or key.condition not in ("load", "noload")
        or not re.fullmatch("[0-9]{1,3}", key.episode)
    ):
        raise DataError(
            "Writing the raw layout: needs a unit of six digits, a condition load or noload and an episode below 1000, "
            f"found {key}; rename it or write Parquet instead."
        )


def _write_folder(population: Population, keys: tuple[EpisodeKey, ...], folder: Path, index: int) -> None:
    unit, condition = keys[0].unit, keys[0].condition
    group = OUTLIERS if population.unit(unit).group == OUTLIERS else "population"
    stamp = (FIRST_STAMP + timedelta(minutes=10 * index)).strftime("%Y%m%dT%H%M%S")
    target = folder / "batch_b" / group / f"{stamp}_{unit}_{condition}"
    target.mkdir(parents=True)
    for key in keys:
        values = population.read(key)
        (target / f"{stamp}_{unit}_{condition}_{int(key.episode):03d}.csv").write_bytes(
            raw_csv(values, population.sample_period_s)
        )


def raw_csv(values: npt.NDArray[np.float64], sample_period_s: float) -> bytes:
    """Return one raw file."""
    import pyarrow as pa
    from pyarrow import csv

    recorded = values.copy()
    recorded[TARGET_LAG:, 3:] = values[:-TARGET_LAG, 3:]
    recorded[:TARGET_LAG, 3:] = values[0, 3:]
    recorded /= np.array([MOTOR_DEG_TO_RAD, MOTOR_DEG_TO_RAD, PERCENT, MOTOR_DEG_TO_RAD, MOTOR_DEG_TO_RAD])
    columns = [np.arange(len(values)) * sample_period_s, *recorded.T]
    rounded = [from_numpy(np.round(column, decimals) + 0.0) for column, decimals in zip(columns, DECIMALS, strict=True)]
    buffer = io.BytesIO(HEADER)
    buffer.seek(len(HEADER))
    csv.write_csv(
        pa.Table.from_arrays(rounded, names=[c.name for c in CHANNELS] + ["time"]),
        buffer,
        csv.WriteOptions(include_header=False),
    )
    return buffer.getvalue()
