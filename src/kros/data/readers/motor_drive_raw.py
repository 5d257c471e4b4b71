"""The paper's raw recordings of motor drives with Harmonic Drive gearboxes, both ways: CSV files with a fixed mapping.

    raw/batch_b/{population,outliers}/<YYYYmmddTHHMMSS>_<serial>_<load|noload>/*_<episode>.csv

Columns, by position after one header line: time (s, also ms or us), position (deg), velocity (deg/s), torque (% of
full scale), target position (deg), target velocity (deg/s), all on the motor side of a gear of ratio 100. `STEPS`
declares the preparation.
"""

import math
import re
from pathlib import Path

import numpy as np

from ...core import DataError, whole_folder
from ..population import OUTLIERS, Channel, Population, Role
from ..prepare import prepare
from ..steps import Offset, Scale, Shift, Step, Trim
from .csv_folder import ChannelMapping, CsvMapping, csv_files, read_csv_folder
from .tables import from_numpy

GEAR_RATIO = 100
RADIANS = math.pi / 180 / GEAR_RATIO  # at the gear's output of a degree at the motor
PERCENT = 1 / 100
PERIOD_S = 1 / 1000
REST = 1000  # samples at rest before an episode; in the second half of them the position is at its target
LAG = 1  # samples by which targets lag the measurements
STAMP = "20230101T000000"  # of the folders that are written
GROUPS = ("population", OUTLIERS)
CHANNELS = (
    Channel("position", Role.STATE, "deg", measured=True),
    Channel("velocity", Role.STATE, "deg/s"),
    Channel("current", Role.STATE, "%"),
    Channel("target_position", Role.INPUT, "deg"),
    Channel("target_velocity", Role.INPUT, "deg/s"),
)
STEPS: tuple[Step, ...] = (
    Scale(("position", "target_position"), RADIANS, "rad"),
    Scale(("velocity", "target_velocity"), RADIANS, "rad/s"),
    Scale(("current",), PERCENT, "1"),
    Shift(("target_position", "target_velocity"), LAG),
    Offset("position", "target_position", REST // 2, REST),
    Trim(start=REST),
)
FOLDER = r"\d{8}T\d{6}_(?P<unit>\d{6})_(?P<condition>load|noload)"
EPISODE = r"[^/]*(?=\d{3}\.csv$)0{0,2}(?P<episode>\d{1,3})\.csv"  # the last three characters of the stem
MAPPING = CsvMapping(
    files=f"^(?P<group>{'|'.join(GROUPS)})/{FOLDER}/{EPISODE}$",
    time=1,
    channel=tuple(ChannelMapping(**vars(c), column=number) for number, c in enumerate(CHANNELS, start=2)),
    metadata={"plant": "harmonic-drive", "gear_ratio": GEAR_RATIO},
)

HEADER = [
    "time_s",
    "position_deg",
    "velocity_deg_per_s",
    "torque_percent",
    "target_position_deg",
    "target_velocity_deg_per_s",
]


def find_root(source: Path) -> Path | None:
    """Return the folder with ``population`` or ``outliers``: `source`, or its ``batch_b`` (also below ``raw``)."""
    candidates = (source, source / "batch_b", source / "raw" / "batch_b")
    return next((c for c in candidates if any((c / group).is_dir() for group in GROUPS)), None)


def is_raw_layout(source: Path) -> bool:
    """Tell whether a folder in ``population`` or ``outliers``, words that others use too, is named as in the layout."""
    root = find_root(source)
    folders = [path for group in GROUPS for path in root.glob(f"{group}/*")] if root is not None else []
    return any(path.is_dir() and re.fullmatch(FOLDER, path.name) for path in folders)


def read_motor_drive_raw(source: Path) -> Population:
    """Read the paper's raw layout, sampled at 1 kHz, so steps of time of 1 are ms and of 1000 are us."""
    root, what = find_root(source), f"Reading {source} as motor-drive-raw"
    if root is None:
        raise DataError(f"{what}: found no folder 'population' or 'outliers'; set another data.reader.")
    files = [name for name in csv_files(root) if name.endswith(".csv") and name.startswith(GROUPS)]
    strange = next((name for name in files if not re.search(MAPPING.files, name)), None)
    if strange is not None:
        raise DataError(f"{what}: file {root / strange} should be named <time>_<serial>_<load|noload>/*_<episode>.csv.")
    population = read_csv_folder(root, MAPPING)
    for scale in (1e-3, 1e-6):
        if math.isclose(population.sample_period_s * scale, PERIOD_S, rel_tol=0.01):
            population = read_csv_folder(root, MAPPING.model_copy(update={"time_scale": scale}))
    return prepare(population, STEPS)


def write_raw(population: Population, out: Path) -> None:
    """Write recordings before preparation, in the channels and units of the reader, as a whole folder or none."""
    import pyarrow as pa
    from pyarrow import csv

    with whole_folder(out) as folder:
        for unit, condition, keys in population.groups():
            group = OUTLIERS if population.unit(unit).group == OUTLIERS else "population"
            name = f"{STAMP}_{unit}_{condition}"
            target = folder / "batch_b" / group / name
            target.mkdir(parents=True)
            for key in keys:
                recorded = population.read(key) / np.array([RADIANS, RADIANS, PERCENT, RADIANS, RADIANS])
                recorded[LAG:, 3:] = recorded[:-LAG, 3:].copy()
                columns = [np.arange(len(recorded)) * population.sample_period_s, *recorded.T]
                table = pa.Table.from_arrays([from_numpy(column) for column in columns], names=HEADER)
                csv.write_csv(table, target / f"{name}_{int(key.episode):03d}.csv")
