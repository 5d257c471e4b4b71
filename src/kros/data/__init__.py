"""Recordings: units, conditions and episodes with named channels, read lazily, prepared by declared steps, checked."""

from . import steps
from .checks import check_episode, check_population, scan_population
from .population import DEFAULT_CONDITION, OUTLIERS, Channel, EpisodeKey, Population, Role, Split, Unit, split_episodes
from .prepare import prepare
from .readers.arrays import from_arrays
from .readers.motor_drive_raw import read_motor_drive_raw
from .readers.parquet import read_parquet
from .write_raw import write_raw
from .writers import write_group, write_index, write_parquet

__all__ = [
    "DEFAULT_CONDITION",
    "OUTLIERS",
    "Channel",
    "EpisodeKey",
    "Population",
    "Role",
    "Split",
    "Unit",
    "check_episode",
    "check_population",
    "from_arrays",
    "prepare",
    "read_motor_drive_raw",
    "read_parquet",
    "scan_population",
    "split_episodes",
    "steps",
    "write_group",
    "write_index",
    "write_parquet",
    "write_raw",
]
