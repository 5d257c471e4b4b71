"""The paper's raw recordings of motor drives with Harmonic Drive gearboxes: a folder of CSV files with a fixed mapping.

    raw/batch_b/{population,outliers}/<YYYYmmddTHHMMSS>_<serial>_<load|noload>/*_<episode>.csv

Columns, by position after one header line: time (s, also ms or us), position (deg), velocity (deg/s), torque (% of
full scale), target position (deg), target velocity (deg/s), all on the motor side of a gear of ratio 100. `STEPS`
declares the preparation.
"""

from __future__ import annotations

import logging
import math
import re
from pathlib import Path

from ...core.errors import DataError
from ..population import OUTLIERS, Channel, Population, Role
from ..steps import Offset, Scale, Shift, Step, Trim
from .csv_folder import csv_files, read_csv_folder
from .csv_mapping import ChannelMapping, CsvMapping

logger = logging.getLogger(__name__)

GEAR_RATIO = 100
PERIOD_S = 1e-3
REST_SAMPLES = 1000
TARGET_LAG = 1
GROUPS = ("population", OUTLIERS)
CHANNELS = (
    Channel("position", Role.STATE, "deg", measured=True),
    Channel("velocity", Role.STATE, "deg/s"),
    Channel("current", Role.STATE, "%"),
    Channel("target_position", Role.INPUT, "deg"),
    Channel("target_velocity", Role.INPUT, "deg/s"),
)
MOTOR_DEG_TO_RAD = math.pi / 180 / GEAR_RATIO
PERCENT = 0.01
STEPS: tuple[Step, ...] = (
    Scale(("position", "target_position"), MOTOR_DEG_TO_RAD, "rad"),
    Scale(("velocity", "target_velocity"), MOTOR_DEG_TO_RAD, "rad/s"),
    Scale(("current",), PERCENT, "1"),
    Shift(("target_position", "target_velocity"), TARGET_LAG),
    Offset("position", "target_position", 500, 1000),
    Trim(start=REST_SAMPLES),
)
FOLDER = r"\d{8}T\d{6}_(?P<unit>\d{6})_(?P<condition>load|noload)"
EPISODE = r"[^/]*(?=\d{3}\.csv$)0{0,2}(?P<episode>\d{1,3})\.csv"  # the last three characters of the stem
MAPPING = CsvMapping(
    files=f"^(?P<group>{'|'.join(GROUPS)})/{FOLDER}/{EPISODE}$",
    time=1,
    channel=tuple(
        ChannelMapping(name=c.name, role=c.role, unit=c.unit, measured=c.measured, column=number)
        for number, c in enumerate(CHANNELS, start=2)
    ),
    prepare=STEPS,
    metadata={"plant": "harmonic-drive", "gear_ratio": GEAR_RATIO},
)


def find_root(source: Path) -> Path | None:
    """Return the folder with ``population`` or ``outliers``: `source`, or its ``batch_b`` (also below ``raw``)."""
    for candidate in (source, source / "batch_b", source / "raw" / "batch_b"):
        if any((candidate / group).is_dir() for group in GROUPS):
            return candidate
    return None


def is_raw_layout(source: Path) -> bool:
    """Tell whether a folder in ``population`` or ``outliers``, words that others use too, is named as in the layout."""
    root = find_root(source)
    folders = [path for group in GROUPS for path in root.glob(f"{group}/*")] if root is not None else []
    return any(path.is_dir() and re.fullmatch(FOLDER, path.name) for path in folders)


def read_motor_drive_raw(source: Path | str) -> Population:
    """Read the paper's raw layout, sampled at 1 kHz, so steps of time of 1 are ms and of 1000 are us."""
    root, what = find_root(Path(source)), f"Reading {source} as motor-drive-raw"
    if root is None:
        missing = "found no folder 'population' or 'outliers', nor 'batch_b' with one of them"
        raise DataError(f"{what}: {missing}; check the path.")
    files = [name for _, name in csv_files(root) if name.endswith(".csv") and name.startswith(GROUPS)]
    strange = next((name for name in files if not re.search(MAPPING.files, name)), None)
    if strange is not None:
        wanted = "<YYYYmmddTHHMMSS>_<serial, 6 digits>_<load|noload>/*_<episode, 3 digits>.csv"
        raise DataError(f"{what}: file {root / strange} should be named {wanted}; rename it or move it away.")
    population = read_csv_folder(root, MAPPING)
    period = population.sample_period_s
    scale = next((s for s in (1.0, 1e-3, 1e-6) if math.isclose(period * s, PERIOD_S, rel_tol=0.01)), None)
    if scale is None:
        text = "The raw layout is sampled at 1 kHz, found steps of %g in %s; rest and offset are counted in samples."
        logger.warning(text, period, population.episodes[0])
    return (
        population if scale in (None, 1.0) else read_csv_folder(root, MAPPING.model_copy(update={"time_scale": scale}))
    )
