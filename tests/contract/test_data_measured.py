"""Readers on measured recordings (the folder named by KROS_DATA); facts from the notes that come with them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kros.core.errors import DataError
from kros.data import EpisodeKey, prepare, read, steps
from kros.data.recording import check_population

PENDULUM_SIGNALS = [
    ("position", "state", "pos_meas", "rad"),
    ("velocity", "state", "vel_meas", "rad/s"),
    ("torque", "state", "tau_meas", "N m"),
    ("command", "input", "tau_con", "N m"),
]
PENDULUM: dict[str, Any] = {
    "files": r"design_(?P<unit>[AC]\.[01])__(\d+_trajectory_|\d+-)(?P<episode>\d+)",
    "exclude": r"C\.0.*_1[23]\.",
    "time": "time",
    "channel": [{"name": n, "role": r, "unit": u, "measured": n == "position"} for n, r, _, u in PENDULUM_SIGNALS],
    "unit": [{"suffix": f"/joint{j}", "columns": {n: f"{c}{j}" for n, _, c, _ in PENDULUM_SIGNALS}} for j in (1, 2)],
}


def test_geared_drives_two_to_a_file_with_jitter(recordings: Path) -> None:
    folder = recordings / "dfki_double_pendulum"
    population = read(folder, "csv", mapping=PENDULUM)
    assert population.unit_ids == ("A.0/joint1", "A.0/joint2", "C.0/joint1", "C.0/joint2", "C.1/joint1", "C.1/joint2")
    assert [len(population.keys(u)) for u in population.unit_ids] == [9, 9, 7, 7, 10, 10]
    check_population(population)
    with pytest.raises(DataError, match=r"uneven time.*resample"):
        population.read(population.episodes[0])
    even = prepare(population, [steps.Resample(1 / 400)])
    for key in even.episodes:
        values = even.read(key)
        assert 2000 < len(values) < 4500  # about ten seconds at 400 Hz
        assert np.abs(values[:, 1]).max() < 35
    values = even.read(EpisodeKey("A.0/joint1", "default", "00"))
    speed = np.gradient(values[:, 0], 1 / 400)
    assert np.corrcoef(speed, values[:, 1])[0, 1] > 0.98  # the two columns of one drive belong together
