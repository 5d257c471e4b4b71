"""Units that are recorded in another unit of measure, or with another sign, are named; those of a spread batch are not."""

from __future__ import annotations

import numpy as np
import pytest

import kros
from kros.identify.likeness import apart, course, moments, odd, unlike


@pytest.fixture(scope="module")
def motors():
    return kros.plants.DcMotorPopulation(n_units=5, n_episodes=2, seconds=1.0, seed=3, spread=3.0).simulate().population


def copied(motors) -> dict[str, list[np.ndarray]]:
    return {unit: [motors.read(key).copy() for key in motors.keys(unit)] for unit in motors.unit_ids}


def alerts(motors, data: dict[str, list[np.ndarray]]) -> tuple[str, ...]:
    names = {"states": motors.states, "inputs": motors.inputs, "measured": motors.measured}
    found = kros.from_arrays(data, **names, sample_period_s=motors.sample_period_s)
    return kros.identify(found, refine=False).facts.alerts


@pytest.mark.parametrize(("column", "name"), list(enumerate(("position", "velocity", "current", "voltage"))))
def test_another_sign_and_another_unit_of_measure_are_named(motors, column: int, name: str) -> None:
    data, one, other = copied(motors), motors.unit_ids[1], motors.unit_ids[3]
    for unit, factor in ((one, -1.0), (other, np.pi / 180)):
        for values in data[unit]:
            values[:, column] *= factor
    against, size = alerts(motors, data)
    assert against == f"Unit {one}: {name} moves against the other channels, unlike in most; check its sign."
    assert size.startswith(f"Unit {other}: {name} moves 0.01")


def test_values_beyond_those_of_all_other_units_are_named() -> None:
    """A temperature of five units, of one in degrees Fahrenheit; five units at temperatures of their own are as many."""
    low, high = np.array([20.0, 22.0, 21.0, 23.0, 20.5]), np.array([60.0, 55.0, 58.0, 61.0, 59.0])
    low[3], high[3] = 1.8 * low[3] + 32, 1.8 * high[3] + 32
    ends = np.stack([0 * low, 0 * low, low, high], axis=-1)[:, None, :, None]
    (text,) = apart(["temperature"], dict(zip("abcde", ends, strict=True)))
    values = "values between 73.4 and 141.8, those of other units between 20 and 60"
    assert text == f"Unit d: temperature has {values}; check its column and unit of measure."
    stairs = ends[:1] + 100 * np.arange(5)[:, None, None, None]
    assert apart(["temperature"], dict(zip("abcde", stairs, strict=True))) == []


def test_a_unit_whose_zero_is_another_is_named(motors) -> None:
    data = copied(motors)
    for values in data[motors.unit_ids[1]]:
        values[:, 0] += 1e4
    (alert,) = alerts(motors, data)
    assert alert.startswith(f"Unit {motors.unit_ids[1]}: position has values between ")


@pytest.mark.parametrize(("column", "name"), list(enumerate(("position", "velocity", "current", "voltage"))))
def test_one_mirrored_episode_of_a_unit_is_named_with_its_channel(motors, column: int, name: str) -> None:
    data = copied(motors)
    data[motors.unit_ids[1]][1][:, column] *= -1
    (alert,) = alerts(motors, data)
    episode = f"Episode 1 of unit {motors.unit_ids[1]} (default)"
    assert alert == f"{episode}: {name} moves against the other channels, unlike in most; check its sign."


def test_one_episode_with_swapped_columns_is_named(motors) -> None:
    data = copied(motors)
    swapped = data[motors.unit_ids[1]][1]
    swapped[:, [1, 2]] = swapped[:, [2, 1]]
    begin = f"Episode 1 of unit {motors.unit_ids[1]} (default): current moves "
    assert any(alert.startswith(begin) for alert in alerts(motors, data))


def test_a_motion_that_turns_a_correlation_in_every_unit_is_no_mirrored_channel() -> None:
    """One of four episodes is above the resonance: there the force is against the position, in all units but one."""
    t, frequencies = np.arange(400) * 0.05, np.array([0.3, 0.4, 0.5, 3])
    waves = [(np.sin(f * t), f * np.cos(f * t), (1 - f**2) * np.sin(f * t)) for f in frequencies]
    episodes = [np.column_stack(wave) / (1 - f**2) for f, wave in zip(frequencies, waves, strict=True)]
    units = {unit: {f"{k}": moments(values) for k, values in enumerate(episodes)} for unit in "abcde"}
    units["a"]["3"] = units["a"]["2"]
    channels = ["position", "velocity", "force"]
    assert unlike(channels, units) == []
    units["b"]["1"] = moments(episodes[1] * (1, -1, 1))
    expected = "1: position or velocity moves against the other channels, unlike in most; check its sign."
    assert unlike(channels, units) == [expected]


def test_a_sensor_that_fails_for_a_while_is_named_with_its_episode(motors) -> None:
    data = copied(motors)
    data[motors.unit_ids[1]][1][300:, 1] = data[motors.unit_ids[1]][1][300, 1]
    data[motors.unit_ids[2]][0][200:203, 0] = -9999.0
    _, stuck, code = alerts(motors, data)  # and the size of its position
    assert stuck.startswith(f"Episode 1 of unit {motors.unit_ids[1]} (default): velocity stays the same for 40 % of it")
    assert code.startswith(f"Episode 0 of unit {motors.unit_ids[2]} (default): position jumps by ")


@pytest.mark.parametrize("turn", [2 * np.pi, 360.0])
def test_a_wrapped_angle_is_named(turn: float) -> None:
    t = np.arange(3000) * 1e-3
    angle = turn * (3 * t + 0.4 * np.sin(4 * t))
    wrapped, levels = angle % turn - turn / 2, turn * np.round(np.random.default_rng(0).random(3000))
    courses = np.array([course(np.column_stack([angle, wrapped, levels, np.sign(np.sin(t))]))] * 2)
    (text,) = odd(["Episode 1", "Episode 2"], ["angle", "wrapped", "levels", "sign"], courses)
    assert text.startswith("Episode 1: wrapped jumps by a full turn, in 2 episodes, as a wrapped angle")


@pytest.mark.parametrize("share", [1.0, 0.05])
def test_a_batch_with_spread_and_a_unit_that_is_moved_less_are_not_doubted(motors, share: float) -> None:
    data = copied(motors)
    for values in data[motors.unit_ids[2]]:
        values *= share
    assert alerts(motors, data) == ()
