"""What makes an episode or a population unusable."""

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scans import scan_digests

from kros.core.errors import DataError
from kros.data import Channel, EpisodeKey, Population, Role, Unit, from_arrays
from kros.data.recording import check_episode, check_population

CHANNELS = (Channel("x", Role.STATE, measured=True), Channel("v", Role.STATE), Channel("u", Role.INPUT))
KEY = EpisodeKey("001011", "load", "7")


def values(seed: int = 0, n: int = 20) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, 3))


def population(episodes: Any = None, units: tuple[Unit, ...] = ()) -> Population:
    return from_arrays(
        episodes or {"a": [values(0), values(1)], "b": [values(2), values(3)]}, CHANNELS, 0.1, units=units
    )


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


def test_empty_and_duplicate() -> None:
    with pytest.raises(DataError, match="population is empty"):
        from_arrays({}, CHANNELS, 0.1)
    good = population()
    with pytest.raises(DataError, match="population is empty"):
        check_population(replace(good, episodes=()))
    with pytest.raises(DataError, match=r"Duplicate episodes: episode 0 of unit a \(default\);"):
        check_population(replace(good, episodes=(*good.episodes, good.episodes[0])))


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
    with pytest.raises(
        DataError,
        match=r"Unit a \(default\): state 'x' stays where it is in each of 2 episodes, in the first at 0; check",
    ):
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


@pytest.mark.parametrize("value", [-1e308, 1e51])
def test_a_sample_that_cannot_be_computed_with_is_located(value: float) -> None:
    """Products of samples stay finite, so that no warning of NumPy reaches a user."""
    bad = values()
    bad[7, 2] = value
    with pytest.raises(DataError, match=r"channel 'u' has 1 above 1e\+50 at sample 7"):
        check_episode(bad, KEY, CHANNELS)


def test_an_input_may_be_held_and_a_machine_may_rest() -> None:
    held, rest = values(), values()
    held[:, 2] = 0.0
    check_episode(held, KEY, CHANNELS)
    rest[:] = 1.0, 2.5, 0.0
    check_episode(rest, KEY, CHANNELS)
