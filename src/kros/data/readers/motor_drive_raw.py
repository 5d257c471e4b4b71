"""The paper's raw recordings of motor drives with Harmonic Drive gearboxes.

    raw/batch_b/{population,outliers}/<YYYYmmddTHHMMSS>_<serial>_<load|noload>/*_<episode>.csv

Columns, by position after one header line: time (s, also ms or us), position (deg), velocity (deg/s), torque (% of full scale), target position (deg),
target velocity (deg/s), all on the motor side of a gear of ratio 100. `STEPS` declares the preparation.
"""

from __future__ import annotations

import logging
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...core.errors import DataError
from ..population import OUTLIERS, Channel, EpisodeKey, Population, Role, Unit
from ..prepare import assemble, episode_order
from ..recording import Recording, Recordings, estimate_period, usable
from ..scaling import Scaling
from ..steps import Offset, Scale, Shift, Step, Trim
from .csvfile import first_fields, read_columns

logger = logging.getLogger(__name__)

GEAR_RATIO = 100
PERIOD_S = 1e-3
REST_SAMPLES = 1000
TARGET_LAG = 1
GROUPS = ("population", OUTLIERS)
METADATA = {"plant": "harmonic-drive", "gear_ratio": GEAR_RATIO}
COLUMNS = ("time", "position", "velocity", "current", "target_position", "target_velocity")
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
FOLDER = re.compile(r"\d{8}T\d{6}_(?P<unit>\d{6})_(?P<condition>load|noload)")


@dataclass(frozen=True, eq=False)
class RawRecordings(Recordings):
    """Reads one raw file at a time."""

    time_scale: float = 1.0

    def file(self, place: str) -> Path:
        """Return the file of an episode."""
        return Path(place)

    def read(self, key: EpisodeKey, place: str) -> Recording:
        """Return one episode as recorded."""
        columns = read_columns(Path(place), COLUMNS, COLUMNS)
        return Recording(
            key, np.ascontiguousarray(columns[1:].T), np.where(usable(columns[0]), columns[0], np.nan) * self.time_scale
        )


def find_root(source: Path) -> Path | None:
    """Return the folder that holds ``population`` or ``outliers``, at `source` or in its ``batch_b`` (also below ``raw``)."""
    for candidate in (source, source / "batch_b", source / "raw" / "batch_b"):
        if any((candidate / group).is_dir() for group in GROUPS):
            return candidate
    return None


def is_raw_layout(source: Path) -> bool:
    """Tell whether some folder in ``population`` or ``outliers`` is named as a recording of the raw layout: other layouts use these words too."""
    root = find_root(source)
    folders = (
        path for group in GROUPS if root is not None and (root / group).is_dir() for path in (root / group).iterdir()
    )
    return any(path.is_dir() and FOLDER.fullmatch(path.name) is not None for path in folders)


def read_motor_drive_raw(source: Path | str) -> Population:
    """Read the paper's raw layout."""
    root = find_root(Path(source))
    if root is None:
        raise DataError(
            f"Reading {source} as motor-drive-raw: found no folder 'population' or 'outliers', nor 'batch_b' with one of "
            "them; check the path."
        )
    groups: dict[str, str] = {}
    files: dict[EpisodeKey, str] = {}
    for group, path, match in _folders(root):
        unit = match["unit"]
        if groups.setdefault(unit, group) != group:
            raise DataError(
                f"Unit {unit} is in both groups {groups[unit]!r} and {group!r} of {root}; move its folders to one of them."
            )
        for episode, file in _episodes(path):
            key = EpisodeKey(unit, match["condition"], episode)
            if key in files:
                raise DataError(
                    f"Duplicate episodes: {key} is in {files[key]} and in {file}; remove or renumber one of them."
                )
            files[key] = file
    for file in files.values():
        _check_header(Path(file))
    units = [Unit(unit, group) for unit, group in groups.items()]
    if not files:
        raise DataError(
            f"Reading {source} as motor-drive-raw: found {len(groups)} folders of units and no .csv in them; check the path."
        )
    recordings = RawRecordings(files, _time_scale(RawRecordings(files)(min(files, key=episode_order))))
    scaling = {name: Scaling(number + 1) for number, name in enumerate(COLUMNS) if number}
    return assemble(recordings, CHANNELS, units, metadata=METADATA, steps=STEPS, scaling=scaling)


def _time_scale(first: Recording) -> float:
    """Return the factor from the column of time to seconds: the layout is sampled at 1 kHz, so steps of 1 are ms and of 1000 are us."""
    period = estimate_period(first)
    for scale in (1.0, 1e-3, 1e-6):
        if math.isclose(period * scale, PERIOD_S, rel_tol=0.01):
            return scale
    logger.warning(
        "The raw layout is sampled at 1 kHz, found steps of %g in %s; rest and offset are counted in samples.",
        period,
        first.key,
    )
    return 1.0


def _folders(root: Path) -> Iterator[tuple[str, Path, re.Match[str]]]:
    for group in GROUPS:
        if not (root / group).is_dir():
            continue
        for path in sorted(p for p in (root / group).iterdir() if p.is_dir() and not p.name.startswith(".")):
            match = FOLDER.fullmatch(path.name)
            if match is None:
                raise DataError(
                    f"Folder {path} should be named <YYYYmmddTHHMMSS>_<serial, 6 digits>_<load|noload>; rename it or move it away."
                )
            yield group, path, match


def _episodes(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield (episode, file) of one folder; the last three characters of the stem number the episode."""
    for name in sorted(os.listdir(folder)):
        if not name.endswith(".csv") or name.startswith("."):
            continue
        number = name[:-4][-3:]
        if not re.fullmatch(r"[0-9]{3}", number):
            raise DataError(
                f"File {folder / name}: the last three characters before .csv should number the episode, found {number!r}; rename it."
            )
        yield str(int(number)), str(folder / name)


def _check_header(file: Path) -> None:
    fields = first_fields(file)
    if len(fields) != len(COLUMNS):
        problem = "missing" if len(fields) < len(COLUMNS) else "extra"
        raise DataError(
            f"Reading {file}: {len(COLUMNS)} columns are needed ({', '.join(COLUMNS)}), found {len(fields)}: {fields}; "
            f"{problem} columns, correct the file."
        )
    if all(re.fullmatch(r"[-+]?[0-9.]+([eE][-+]?[0-9]+)?", field) for field in fields):
        raise DataError(
            f"Reading {file}: one header line is needed, found numbers in the first line: {fields}; put the names of the columns first."
        )
