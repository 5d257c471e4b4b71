"""The ratio of a gear in recordings: found where the simulation has one, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from kros.data import Channel, Population, Role, from_arrays
from kros.identify.periodic import periodic_term
from kros.plants import DcMotorPopulation, HarmonicDrivePopulation, PendulumPopulation

CHANNELS = (
    Channel("angle", Role.STATE, "rad", measured=True),
    Channel("rate", Role.STATE, "rad/s"),
    Channel("torque", Role.INPUT, "N m"),
)


def gears(ratio: float, size: float, units: int = 3, noise: float = 1e-3, travel: float = 6.0) -> Population:
    """An axis with damping and a ripple ``size * sin(ratio * angle + phase)`` of its rate, every unit with a phase of
    its own."""
    episodes = {}
    for unit in range(units):
        rng = np.random.default_rng([unit, 7])
        episodes[str(unit)] = []
        for _ in range(2):
            n, x = 6000, np.zeros((6000, 2))
            u = np.repeat(rng.normal(size=n // 200), 200)
            for k in range(n - 1):
                ripple = size * np.sin(ratio * x[k, 0] + unit)
                x[k + 1] = x[k, 0] + 1e-3 * x[k, 1], 0.995 * x[k, 1] + 0.005 * travel * u[k] + ripple
            episodes[str(unit)].append(np.column_stack([x + noise * rng.normal(size=x.shape) * [0.0, 1.0], u]))
    return from_arrays(episodes, CHANNELS, 1e-3)


def term_of(population, angle):
    condition = population.conditions[-1]
    keys = [k for unit in population.unit_ids for k in population.keys(unit, condition)[:3]]
    return periodic_term(population, [angle], keys)


@pytest.mark.parametrize(("seed", "loop"), [(0, "stiff"), (5, "soft")])
def test_the_gear_of_the_simulated_drives_is_found(seed, loop):
    drives = HarmonicDrivePopulation(n_units=2, n_episodes=3, seconds=8, seed=seed, loop=loop).simulate().population
    term = term_of(drives, "position")
    assert term is not None
    assert term.ratio == 100
    assert term.above > 20


@pytest.mark.parametrize("ratio", [23.0, 80.5, 120.0])
def test_any_ratio_is_found_to_a_part_of_a_turn(ratio):
    term = term_of(gears(ratio, 2e-3), "angle")
    assert term is not None
    assert term.ratio == pytest.approx(ratio, abs=0.1)


def test_nothing_is_found_where_nothing_is_periodic():
    motors = DcMotorPopulation(n_units=4, n_episodes=4, seconds=8, seed=1).simulate().population
    assert term_of(motors, "position") is None
    for seed in range(2):
        rng = np.random.default_rng(seed)
        noisy = gears(1.0, 0.0, noise=1e-2 * rng.uniform(0.5, 2))
        assert term_of(noisy, "angle") is None


def test_gravity_is_found_in_pendulums():
    pendulums = PendulumPopulation(n_units=3, n_episodes=4, seconds=8, seed=2).simulate().population
    term = term_of(pendulums, "position")
    assert term is not None
    assert term.ratio == 1
    assert term.odd
