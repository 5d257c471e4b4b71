"""Recordings: units, conditions and episodes with named channels, read lazily, prepared by declared steps, checked.

folder or arrays ── reader ── Population ── prepare ── check ── write_parquet, or the stages of a study

Examples
--------
>>> import numpy as np
>>> from kros.data import Channel, Role, from_arrays
>>> states = Channel("angle", Role.STATE, "rad", measured=True), Channel("rate", Role.STATE, "rad/s")
>>> channels = (*states, Channel("torque", Role.INPUT, "N m"))
>>> population = from_arrays({"left": [np.zeros((50, 3))], "right": [np.ones((50, 3))]}, channels, 0.01)
>>> population.measured, population.read(population.keys("right")[0]).shape
(('angle',), (50, 3))
"""

from . import steps
from .batch import EpisodeBatch
from .population import (
    DEFAULT_CONDITION,
    OUTLIERS,
    Channel,
    EpisodeKey,
    Population,
    Role,
    Unit,
    natural_key,
    scaling_of,
    split_episodes,
)
from .prepare import prepare
from .readers.arrays import from_arrays, from_frame
from .readers.opening import detect_reader, read
from .readers.parquet import read_parquet, write_parquet
from .recording import NonFiniteError, some
from .shown import Shown

__all__ = [
    "Channel",
    "EpisodeBatch",
    "EpisodeKey",
    "Population",
    "Role",
    "Unit",
    "from_arrays",
    "from_frame",
    "prepare",
    "read",
    "read_parquet",
    "split_episodes",
    "steps",
    "write_parquet",
]
