"""Readers on measured recordings (the folder named by KROS_DATA); facts from the notes that come with them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kros.core.errors import DataError
from kros.data import EpisodeKey, prepare, read, split_episodes, steps
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
QUBE: dict[str, Any] = {
    "files": r"qube_(?P<episode>\d+T\d+)",
    "time": "t",
    "channel": [
        {"name": "theta", "column": "theta", "role": "state", "unit": "rad", "measured": True},
        {"name": "alpha", "column": "alpha", "role": "state", "unit": "rad", "measured": True},
        {"name": "target", "column": "target_theta", "role": "input", "unit": "rad"},
        {"name": "voltage", "column": "plant_input", "role": "input", "unit": "V"},
    ],
    "prepare": [{"step": "trim", "start": 500}],
}
PNEUMATIC: dict[str, Any] = {
    "files": r"^friction__(?P<unit>.+)_(?P<condition>\d+bar)\.csv\.gz$",
    "delimiter": "\t",
    "header": False,
    "time": 1,
    "time_scale": 1e-3,
    "channel": [
        {"name": "position", "column": 5, "role": "state", "unit": "m", "measured": True, "scale": 1e-3},
        {"name": "force", "column": 7, "role": "state", "unit": "N"},
        {"name": "pressure", "column": 6, "role": "input", "unit": "bar"},
    ],
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


def test_rotary_pendulum_with_spaces_in_its_header(recordings: Path) -> None:
    population = read(recordings / "quanser_qube", "csv", mapping=QUBE)
    assert population.sample_period_s == 0.002
    assert len(population.episodes) == 12
    assert all(population.read(key).shape == (9500, 4) for key in population.episodes)
    assert [k.episode for k in split_episodes(population)["unit", "default"].test] == ["20230828T164323"]
    with pytest.raises(DataError, match="at least two units"):
        check_population(population)


def test_pneumatic_cylinders_without_header(recordings: Path) -> None:
    smooth = [
        {"step": "resample", "period_s": 0.02, "max_gap_s": 3.0},
        {"step": "differentiate", "channel": "position", "name": "velocity", "cutoff_hz": 3.0, "unit": "m/s"},
    ]
    population = read(recordings / "pneumatic_cc0", "csv", mapping=PNEUMATIC, prepare=smooth)
    assert len(population.unit_ids) == 9
    assert {"1bar", "3bar", "5bar", "7bar"} <= set(population.conditions)
    assert population.states == ("position", "force", "velocity")
    values = population.read(EpisodeKey("O-ring257", "5bar", "0"))
    assert values[:, 3].mean() == pytest.approx(5, abs=0.3)
    # The velocity integrates back to the position.
    travel = np.cumsum(values[:, 2]) * 0.02
    np.testing.assert_allclose(travel - travel[0], values[:, 0] - values[0, 0], atol=2e-3)
    raw = read(recordings / "pneumatic_cc0", "csv", mapping=PNEUMATIC)
    with pytest.raises(DataError, match="uneven time"):
        raw.read(raw.episodes[0])
