"""Run `study.toml` on the measured recordings: `pneumatic_cc0` in the folder of the environment variable KROS_DATA.

The test bench imposes the stroke. Its speed and the sign of its speed, on which friction depends, are inputs as well.
They are differences of past samples, so that a running observer can compute them. The mean of each signal over the first
70 % is subtracted.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import numpy as np

from kros.cli import app
from kros.data import Channel, EpisodeKey, Population, Role, from_arrays, read, write_parquet
from kros.data.steps import Resample

PIECES, PIECE, TRAINING, STEPS_BACK = 10, 310, 0.7, 5
CREEP_MM_S = 0.5


def prepared(raw: Population) -> Population:
    """Return ten pieces of 6.2 s of every recording with speed and direction as inputs."""
    episodes = {}
    for key in raw.episodes:
        values = raw.read(key)
        values = values - values[: int(TRAINING * len(values))].mean(axis=0)
        speed = (values[STEPS_BACK:, 2] - values[:-STEPS_BACK, 2]) / (STEPS_BACK * raw.sample_period_s)
        whole = np.column_stack([values[STEPS_BACK:], speed, np.tanh(speed / CREEP_MM_S)])
        for i, piece in enumerate(np.array_split(whole, PIECES)):
            episodes[EpisodeKey(key.unit, key.condition, str(i))] = piece[:PIECE]
    added = (Channel("speed", Role.INPUT, "mm/s"), Channel("direction", Role.INPUT))
    return from_arrays(episodes, (*raw.channels, *added), raw.sample_period_s)


if __name__ == "__main__":
    here = Path(__file__).parent
    if "KROS_DATA" not in os.environ:
        sys.exit("Set KROS_DATA to the folder that holds pneumatic_cc0; study.toml says where it is published.")
    even = Resample(0.02, max_gap_s=3.0)  # half the steps are a little longer than 10 ms; one recording rests for 2.7 s
    recordings = read(Path(os.environ["KROS_DATA"]) / "pneumatic_cc0", mapping=here / "recordings.toml", prepare=[even])
    with tempfile.TemporaryDirectory() as folder:
        write_parquet(prepared(recordings), Path(folder) / "recordings")
        source = f"data.source={Path(folder) / 'recordings'}"
        app(["run", str(here / "study.toml"), "--set", source, "--until", "report", *sys.argv[1:]])
