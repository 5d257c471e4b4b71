"""Recordings: units, conditions and episodes with named channels, read lazily, prepared by declared steps, checked.

folder or arrays ── reader ── Population ── prepare ── check ── write_parquet, or the stages of a study

Examples
--------
>>> import numpy as np
>>> from kros.data import Channel, Role, from_arrays
>>> channels = (Channel("angle", Role.STATE, "rad", measured=True), Channel("rate", Role.STATE, "rad/s"), Channel("torque", Role.INPUT, "N m"))
>>> population = from_arrays({"left": [np.zeros((50, 3))], "right": [np.ones((50, 3))]}, channels, sample_period_s=0.01)
>>> population.measured, population.read(population.keys("right")[0]).shape
(('angle',), (50, 3))
"""

from . import steps
from .batch import EpisodeBatch
from .checks import check_episode, check_population, scan_population
from .population import DEFAULT_CONDITION, OUTLIERS, Channel, EpisodeKey, Population, Role, Split, TrueChannel, Unit, split_episodes
from .prepare import prepare
from .readers import (
    READERS,
    CsvMapping,
    detect_reader,
    from_arrays,
    from_frame,
    from_pykoop,
    read,
    read_csv_folder,
    read_motor_drive_raw,
    read_parquet,
    to_pykoop,
)
from .writers import GroupRecord, write_group, write_index, write_parquet, write_raw

__all__ = [
    "DEFAULT_CONDITION",
    "OUTLIERS",
    "READERS",
    "Channel",
    "CsvMapping",
    "EpisodeBatch",
    "EpisodeKey",
    "GroupRecord",
    "Population",
    "Role",
    "Split",
    "TrueChannel",
    "Unit",
    "check_episode",
    "check_population",
    "detect_reader",
    "from_arrays",
    "from_frame",
    "from_pykoop",
    "prepare",
    "read",
    "read_csv_folder",
    "read_motor_drive_raw",
    "read_parquet",
    "scan_population",
    "split_episodes",
    "steps",
    "to_pykoop",
    "write_group",
    "write_index",
    "write_parquet",
    "write_raw",
]
