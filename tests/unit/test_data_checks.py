"""What makes an episode or a population unusable, and what is odd and used: wild samples, repeated stamps, other layouts."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scans import scan_digests

from kros.core.errors import DataError
from kros.data import Channel, EpisodeKey, Population, Role, from_arrays, prepare
from kros.data.readers.csv_folder import read_csv_folder
from kros.data.readers.opening import detect_reader
from kros.data.recording import check_episode, check_population
from kros.data.steps import Resample, Scale
from kros.identify.survey import survey

CHANNELS = (Channel("x", Role.STATE, measured=True), Channel("v", Role.STATE), Channel("u", Role.INPUT))
KEY = EpisodeKey("001011", "load", "7")


def values(seed: int = 0, n: int = 20) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, 3))


def population(episodes: Any = None) -> Population:
    return from_arrays(episodes or {"a": [values(0), values(1)], "b": [values(2), values(3)]}, CHANNELS, 0.1)


@pytest.mark.parametrize(
    ("rows", "value", "found"),
    [
        (slice(12, 15), np.nan, "3 NaN at samples 12-14"),
        (slice(12, 13), np.nan, "1 NaN at sample 12"),
        (slice(0, 2), np.inf, "2 infinity at samples 0-1"),
        (slice(3, 5), [np.nan, -np.inf], "2 NaN and infinity at samples 3-4"),
    ],
)
def test_non_finite(rows: slice, value: Any, found: str) -> None:
    bad = values()
    bad[rows, 1] = value
    bridge = r'bridge short gaps by \[\[data\.prepare\]\] step = "resample"'
    advice = rf"fix the source, {bridge}, or set data\.on_nan = \"drop_episode\""
    match = rf"^Episode 7 of unit 001011 \(load\): channel 'v' has {found}; {advice}\.$"
    with pytest.raises(DataError, match=match):
        check_episode(bad, KEY, CHANNELS)


@pytest.mark.parametrize("level", [0.0, 2.5, -1e9, 0.1])
@pytest.mark.parametrize("column", [0, 1])
def test_a_stuck_sensor_is_named(column: int, level: float) -> None:
    stuck = values()
    stuck[:, column] = level
    match = rf"^Episode 7 of unit 001011 \(load\): state '{'xv'[column]}' stays at .* in all 20 samples .*stuck"
    with pytest.raises(DataError, match=match):
        check_episode(stuck, KEY, CHANNELS)
    stuck[7, column] += 1e-3 * max(1.0, abs(level))
    check_episode(stuck, KEY, CHANNELS)


def test_short_and_misshapen() -> None:
    check_episode(values(n=3), KEY, CHANNELS)
    with pytest.raises(DataError, match="needs at least 3 samples, found 2"):
        check_episode(values(n=2), KEY, CHANNELS)
    with pytest.raises(DataError, match=r"3 channels, .* shape \(20, 2\)"):
        check_episode(values()[:, :2], KEY, CHANNELS)


def test_population_of_two_passes_and_one_does_not() -> None:
    check_population(population())
    one = population({"a": [values(0), values(1)]})
    with pytest.raises(DataError, match=r"at least two units .* found 1 \(a\).*--until identify"):
        check_population(one)
    check_population(one, allow_single=True)


def test_nothing_measured() -> None:
    with pytest.raises(DataError, match=r"No state of \['x', 'v'\] is measured"):
        check_population(replace(population(), columns=(replace(CHANNELS[0], measured=False), *CHANNELS[1:])))


def test_scan_refuses_an_input_that_never_moves() -> None:
    resting = [values(i) for i in range(4)]
    resting[0][:, 2] = 0.0
    scan_digests(population({"a": resting[:2], "b": resting[2:]}))
    resting[1][:, 2] = 0.0
    with pytest.raises(DataError, match=r"Unit a \(default\): input 'u' stays where it is in each of 2 episodes"):
        scan_digests(population({"a": resting[:2], "b": resting[2:]}))


@pytest.mark.parametrize("later", [2.5, -1.0], ids=["same level", "another level"])
def test_scan_refuses_a_state_that_rests_in_every_episode(later: float) -> None:
    stuck = [np.tile([0.0, 2.5, 1.0], (20, 1)), np.tile([1.0, later, 1.0], (30, 1))]
    match = r"Unit a \(default\): state 'x' stays where it is in each of 2 episodes, in the first at 0; check"
    with pytest.raises(DataError, match=match):
        scan_digests(population({"a": stuck}))


def test_scan_drops_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    episodes = {"a": [values(0), values(1)], "b": [values(2), values(3)]}
    episodes["a"][1][3, 0] = np.nan
    episodes["b"][0][4, 1] = np.nan
    bad = population(episodes)
    with pytest.raises(DataError, match="channel 'x' has 1 NaN at sample 3"):
        scan_digests(bad)
    with caplog.at_level(logging.WARNING):
        kept = scan_digests(bad, on_nan="drop_episode")
    assert [key for key, _ in kept] == [EpisodeKey("a", "default", "0"), EpisodeKey("b", "default", "1")]
    assert [r.message.split(":")[1] for r in caplog.records] == [
        " Episode 1 of unit a (default)",
        " Episode 0 of unit b (default)",
    ]


def test_an_input_may_be_held_and_a_machine_may_rest() -> None:
    held, rest = values(), values()
    held[:, 2] = 0.0
    check_episode(held, KEY, CHANNELS)
    rest[:] = 1.0, 2.5, 0.0
    check_episode(rest, KEY, CHANNELS)


UNITS, EPISODES, SAMPLES = 6, 4, 400
MAPPING = {
    "files": r"^(?P<unit>[^/_]+)_(?P<episode>\d+)\.csv$",
    "time": "t",
    "channel": [{"name": c.name, "role": c.role.value, "measured": c.measured} for c in CHANNELS],
}


def waves() -> dict[str, list[np.ndarray]]:
    """Signals of units that differ by some percent."""
    rng, k = np.random.default_rng(4), np.arange(SAMPLES)[:, None]

    def episode() -> np.ndarray:
        sines = np.sin(0.1 * k + rng.uniform(0, 6, 3))
        return (1 + 0.05 * rng.normal(size=3)) * sines + 1e-3 * rng.normal(size=(SAMPLES, 3))

    return {f"u{u}": [episode() for _ in range(EPISODES)] for u in range(UNITS)}


@pytest.mark.parametrize("value", [1e51, -1e308, 1e5, -1e5])
@pytest.mark.parametrize("sample", [0, 17, SAMPLES - 1])
def test_wild_samples_are_refused_with_their_place(value: float, sample: int) -> None:
    """Products of samples stay finite, so that no warning of NumPy reaches a user."""
    data = waves()
    data["u4"][1][sample, 1] = value
    found = r"has 1 above 1e\+50" if abs(value) > 1e50 else "is .*"
    match = rf"Episode 1 of unit u4 \(default\): channel 'v' {found} at sample {sample}[,;]"
    with pytest.raises(DataError, match=match):
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
    data, rng = waves(), np.random.default_rng(7)
    for rows in data.values():
        for values in rows:
            for column in (1, 2):
                values[:, column] = RESTS[kind](np.arange(SAMPLES)) + noise * rng.normal(size=SAMPLES)
    assert len(survey(population(data))[0].episodes) == UNITS * EPISODES
    data["u2"][3][200, 2] = 1e6
    with pytest.raises(DataError, match=r"Episode 3 of unit u2 \(default\): channel 'u' is 1e\+06 at sample 200,"):
        survey(population(data))


def test_short_episodes_are_named() -> None:
    data = waves()
    data["u1"][3] = data["u1"][3][:50]
    match = r"at least 64 samples after preparation; Episode 3 of unit u1 \(default\) has 50"
    with pytest.raises(DataError, match=match):
        survey(population(data), fewest=64)


def written(folder: Path, name: str, time: np.ndarray, values: np.ndarray) -> None:
    np.savetxt(folder / name, np.column_stack([time, values]), delimiter=",", header="t,x,v,u", comments="")


def test_a_last_sample_of_the_same_stamp_is_dropped_and_uneven_time_names_the_file(tmp_path: Path, caplog) -> None:
    rng, time = np.random.default_rng(0), 0.01 * np.arange(100)
    written(tmp_path, "a_1.csv", time, values := rng.normal(size=(100, 3)))
    for more in (1, 2):
        ends = np.vstack([values, *[values[-1:] + 1] * more])
        written(tmp_path, f"a_{1 + more}.csv", np.append(time, [time[-1]] * more), ends)
    written(tmp_path, "b_1.csv", np.where(np.arange(100) > 60, time + 0.004, time), values)
    written(tmp_path, "notes.csv", time, values)
    found = read_csv_folder(tmp_path, MAPPING)
    assert "1 files in" in caplog.text
    assert "notes.csv" in caplog.text
    *repeated, uneven = found.episodes
    for key in repeated:
        np.testing.assert_allclose(found.read(key), values, rtol=1e-12)
    with pytest.raises(DataError, match=r"b_1\.csv: uneven time, .* at sample 60;"):
        found.read(uneven)


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
    hundredfold = Scale(("x",), 100.0)
    for declared in ([], [Resample(0.007)], [hundredfold, Resample(0.004)], [Resample(0.005), hundredfold]):
        resolution = survey(prepare(recorded, declared))[1].resolution
        assert resolution["x"] == pytest.approx(1.0 if hundredfold in declared else 0.01)
