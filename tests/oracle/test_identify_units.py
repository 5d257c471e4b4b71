"""Identification in any units of measure: the same models, phases and warnings, told in these units."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from kros.data import prepare
from kros.data.prepare import scale_population
from kros.data.recording import check_episode, constant
from kros.data.steps import Step
from kros.identify import Factor, PhaseSpec, combine, edmd
from kros.identify.calibration import find_segments
from kros.identify.factors import Ranges, lifted_factor, reduce_episode
from kros.identify.refine import RefineOptions, refine_population
from kros.lifting import Lifting
from kros.plants import DcMotorPopulation, HarmonicDrivePopulation

CHANNELS = ("position", "velocity", "current", "voltage")
SCALINGS = [{name: factor} for name in CHANNELS for factor in (1e-9, 1e9)]
SCALINGS.append({"position": 1e9, "velocity": 1e-9, "current": 1e-9, "voltage": 1e9})
QUICK = RefineOptions(horizons=(5, 60), strengths=(10.0, 1.0), path_iterations=3, segments=4)


@dataclass(frozen=True)
class Multiplied(Step):
    """Other units, and without what states really were."""

    factors: tuple[float, ...] = (1.0,) * len(CHANNELS)

    def apply(self, recording, channels, period_s):
        return replace(recording, values=recording.values[:, : len(self.factors)] * np.array(self.factors))

    def describe(self, signals):
        return replace(signals, channels=signals.channels[: len(self.factors)])


@pytest.fixture(scope="module")
def motors():
    whole = DcMotorPopulation(n_units=3, n_episodes=2, seconds=1.0, seed=2).simulate().population
    return prepare(whole, [Multiplied()])


def in_units(population, factors):
    return prepare(population, [Multiplied(tuple(factors.get(n, 1.0) for n in CHANNELS))])


def lifting_of(factors):
    function = f"tanh({1 / factors['velocity']!r}*velocity)" if "velocity" in factors else "tanh(velocity)"
    return Lifting(CHANNELS[:3], (function,))


def factor_of(population, lifting):
    whole = [
        Factor.stack([reduce_episode(*population.read_parts(k), lifting) for k in population.keys(u)])
        for u in population.unit_ids
    ]
    return lifted_factor(Factor.stack([combine(f) for f in whole]), lifting, {}, lifting)


def sizes_of(factors):
    """What the matrices' rows and columns are multiplied by; the lifted function is a pure number."""
    return np.array([factors.get(n, 1.0) for n in CHANNELS[:3]] + [1.0]), np.array([factors.get("voltage", 1.0)])


def test_in_the_units_of_the_recordings_alpha_is_the_papers(motors):
    factor = factor_of(motors, lifting_of({}))
    ones = Ranges(np.ones(4), np.ones(1))
    np.testing.assert_array_equal(ones.edmd(factor.R, 90.0).A, edmd(factor.R, 4, 90.0).A)
    assert np.abs(Ranges.of(factor, 4).edmd(factor.R, 90.0).A - ones.edmd(factor.R, 90.0).A).max() > 1e-3


@pytest.mark.parametrize("factors", [SCALINGS[3], SCALINGS[4], SCALINGS[-1]], ids=str)
def test_refined_models_are_the_same(motors, factors):
    found = []
    for own in ({}, factors):
        population, lifting = in_units(motors, own), lifting_of(own)
        keys = {u: population.keys(u) for u in population.unit_ids}
        found.append(refine_population(population, keys, lifting, {}, factor_of(population, lifting), None, QUICK))
    models, scaled = found
    x, u = sizes_of(factors)
    np.testing.assert_allclose(scaled.A * x / x[:, None], models.A, atol=1e-6 * np.abs(models.A).max())
    np.testing.assert_allclose(scaled.B * u / x[:, None], models.B, atol=1e-6 * np.abs(models.B).max())


def test_a_scaled_population_is_divided_and_nothing_else(motors):
    scaled = scale_population(motors, {"velocity": 4.0}).select(motors.unit_ids[:2])
    key = scaled.episodes[1]
    np.testing.assert_array_equal(scaled.read(key) * [1, 4, 1, 1], motors.read(key))
    assert [c.unit for c in scaled.channels] == ["rad", "", "A", "V"]
    check_episode(scaled.read(key), key, scaled.channels)


@pytest.fixture(scope="module")
def drive():
    return HarmonicDrivePopulation(n_units=1, n_episodes=1, seconds=8.0, seed=1).simulate().population


@pytest.mark.parametrize("factors", [(1e-9, 1, 1), (1, 1e9, 1), (1, 1, 1e-9), (1e9, 1e-9, 1e9)])
def test_phases_and_lags_are_those_of_the_machine(drive, factors):
    values = drive.read(drive.episodes[0])
    names = drive.states + drive.inputs
    columns = [values[:, names.index(n)] for n in ("position", "target_velocity", "velocity")]
    spec = PhaseSpec()
    one = find_segments(*columns, drive.sample_period_s, spec)
    scaled = find_segments(
        *(c * f for c, f in zip(columns, factors, strict=True)),
        drive.sample_period_s,
        replace(spec, ratio=spec.ratio / factors[0]),
    )
    assert len(scaled) == len(one) > 1
    np.testing.assert_allclose([s.phase for s in scaled], [s.phase for s in one], rtol=1e-6)
    np.testing.assert_allclose([s.speed / factors[0] for s in scaled], [s.speed for s in one], rtol=1e-9)
    # where units match it is the reference's
    assert abs(one[0].speed) == pytest.approx(np.abs(columns[1]).max(), rel=0.01)


def test_a_constant_is_a_constant_in_any_unit():
    same = np.full(1000, 0.1)
    converted = same * (1 + 2e-16 * (np.arange(1000) % 2))  # a bit of rounding apart
    moving = same.copy()
    moving[700] *= 1 + 1e-10
    infinite = np.full(1000, np.inf)  # is told by itself, without a warning
    signals = np.stack([same, converted, np.zeros(1000), moving, 1e-9 * moving, 1e9 * moving, infinite], axis=1)
    assert constant(signals).tolist() == [True] * 3 + [False] * 4
