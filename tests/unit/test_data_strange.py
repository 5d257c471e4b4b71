"""Recordings that are odd rather than unreadable: wild samples, repeated stamps, other layouts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kros.core.errors import DataError
from kros.data import Channel, Population, Role, from_arrays, prepare
from kros.data.readers.csv_folder import read_csv_folder
from kros.data.readers.opening import detect_reader
from kros.data.steps import Resample, Scale
from kros.identify.survey import survey

CHANNELS = (Channel("angle", Role.STATE, "", True), Channel("speed", Role.STATE), Channel("torque", Role.INPUT))
UNITS, EPISODES, SAMPLES = 6, 4, 400
MAPPING = {
    "files": r"^(?P<unit>[^/_]+)_(?P<episode>\d+)\.csv$",
    "time": "t",
    "channel": [
        {"name": "angle", "role": "state", "measured": True},
        {"name": "speed", "role": "state"},
        {"name": "torque", "role": "input"},
    ],
}


def episodes(amplitudes: float = 0.0) -> dict[str, list[np.ndarray]]:
    """Signals of units that differ by some percent, with episodes of different amplitudes."""
    rng = np.random.default_rng(4)
    shape = np.exp(amplitudes * rng.normal(size=EPISODES))
    k = np.arange(SAMPLES)[:, None]

    def episode(size: float) -> np.ndarray:
        return (1 + 0.05 * rng.normal(size=3)) * size * np.sin(
            0.1 * k + rng.uniform(0, 6, 3)
        ) + 1e-3 * size * rng.normal(size=(SAMPLES, 3))

    return {f"u{u}": [episode(size) for size in shape] for u in range(UNITS)}


def population(data: dict[str, list[np.ndarray]]) -> Population:
    return from_arrays(data, CHANNELS, 0.01)


@pytest.mark.parametrize("value", [1e308, -1e308, 1e5, -1e5])
@pytest.mark.parametrize("sample", [0, 17, SAMPLES - 1])
def test_wild_samples_are_refused_with_their_place(value: float, sample: int) -> None:
    data = episodes()
    data["u4"][1][sample, 1] = value
    with pytest.raises(
        DataError, match=rf"Episode 1 of unit u4 \(default\): channel 'speed' (is|has) .* at sample {sample}[,;]"
    ):
        survey(population(data))


RESTS = {  # a channel that stands nearly still but for the last samples
    "flag": lambda k: np.where(k < 4, 0.82 + 0.04 * k, 1.0),
    "step up": lambda k: np.where(k > SAMPLES - 4, 3.0, 0.0),
    "step down": lambda k: np.where(k > SAMPLES - 4, 0.0, 5.0),
    "saturated": lambda k: np.where(k % 200 < 2, -2.0, 10.0),
    "ramp from rest": lambda k: np.maximum(0.0, k - SAMPLES + 4),
}


@pytest.mark.parametrize("noise", [0.0, 1e-3, 1e-5, 1e-7])
@pytest.mark.parametrize("kind", RESTS)
def test_channels_that_rest_for_nearly_all_of_an_episode_are_used(kind: str, noise: float) -> None:
    data, rng = episodes(), np.random.default_rng(7)
    for rows in data.values():
        for values in rows:
            for column in (1, 2):
                values[:, column] = RESTS[kind](np.arange(SAMPLES)) + noise * rng.normal(size=SAMPLES)
    assert len(survey(population(data))[0].episodes) == UNITS * EPISODES
    data["u2"][3][200, 2] = 1e6
    with pytest.raises(DataError, match=r"Episode 3 of unit u2 \(default\): channel 'torque' is 1e\+06 at sample 200,"):
        survey(population(data))


def test_short_episodes_are_named() -> None:
    data = episodes()
    data["u1"][3] = data["u1"][3][:50]
    with pytest.raises(
        DataError, match=r"at least 64 samples after preparation; Episode 3 of unit u1 \(default\) has 50"
    ):
        survey(population(data), fewest=64)


def written(folder: Path, name: str, time: np.ndarray, values: np.ndarray) -> None:
    folder.mkdir(exist_ok=True)
    np.savetxt(
        folder / name, np.column_stack([time, values]), delimiter=",", header="t,angle,speed,torque", comments=""
    )


def test_a_repeated_last_stamp_drops_the_sample_and_uneven_time_names_the_file(tmp_path: Path, caplog) -> None:
    rng, time = np.random.default_rng(0), 0.01 * np.arange(100)
    written(tmp_path, "a_1.csv", time, values := rng.normal(size=(100, 3)))
    written(tmp_path, "a_2.csv", np.append(time, time[-1]), np.vstack([values, values[-1:]]))
    written(tmp_path, "b_1.csv", np.where(np.arange(100) > 60, time + 0.004, time), values)
    written(tmp_path, "notes.csv", time, values)
    found = read_csv_folder(tmp_path, MAPPING)
    assert "1 files in" in caplog.text
    assert "notes.csv" in caplog.text
    np.testing.assert_allclose(found.read(found.episodes[1]), values, rtol=1e-12)
    with pytest.raises(DataError, match=r"b_1\.csv: uneven time, .* at sample 60;"):
        found.read(found.episodes[2])


def test_a_last_sample_of_the_same_stamp_is_dropped_however_often_it_is_written(tmp_path: Path) -> None:
    time, values = 0.01 * np.arange(100), np.random.default_rng(0).normal(size=(100, 3))
    for more in (1, 2):
        ends = np.vstack([values, *[values[-1:] + 1] * more])
        written(tmp_path, f"a_{more}.csv", np.append(time, [time[-1]] * more), ends)
    found = read_csv_folder(tmp_path, MAPPING)
    for key in found.episodes:
        np.testing.assert_allclose(found.read(key), values, rtol=1e-12)


@pytest.mark.parametrize("name", ["population", "outliers"])
def test_folders_of_these_names_are_no_proof_of_the_raw_layout(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    written(tmp_path / name, "m1_1.csv", np.arange(5.0), np.ones((5, 3)))
    assert detect_reader(tmp_path) == "csv"
    (tmp_path / name / "20240101T120000_001011_load").mkdir()
    assert detect_reader(tmp_path) == "motor-drive-raw"


def test_the_resolution_of_a_sensor_is_that_of_what_was_recorded() -> None:
    rng = np.random.default_rng(0)
    episodes = {unit: [np.rint(rng.normal(size=(200, 2)) / 0.1) * 0.01 for _ in range(2)] for unit in "abc"}
    episodes["a"][0][7] += 1e-6  # one sample that is off the grid
    recorded = from_arrays(episodes, states=["x"], measured=["x"], inputs=["u"], sample_period_s=0.01)
    for declared in (
        [],
        [Resample(0.007)],
        [Scale(("x",), 100.0), Resample(0.004)],
        [Resample(0.005), Scale(("x",), 100.0)],
    ):
        resolution = survey(prepare(recorded, declared))[1].resolution
        scale = 100.0 if any(isinstance(step, Scale) for step in declared) else 1.0
        assert resolution["x"] == pytest.approx(0.01 * scale)
