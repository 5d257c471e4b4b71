"""The simulated DC motors and pendulums against steady states on paper and a general integrator."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kros.plants import DcMotorPopulation, PendulumPopulation
from kros.plants.dc_motor import DcMotorTruth


def motors(units=3, **settings):
    return DcMotorPopulation(n_units=units, n_episodes=1, seconds=1.0, seed=3, **settings).simulate().truth


def test_a_constant_voltage_ends_in_the_steady_state_on_paper():
    truth = motors()
    x = truth.respond(np.full((1, 2000), 6.0))[:, :, 0, -1]
    R, k, b, c = truth.resistance, truth.torque_constant, truth.viscous, truth.coulomb
    velocity = (k * 6.0 - R * c) / (k**2 + R * b)  # v = R i + k w and k i = b w + c
    np.testing.assert_allclose(x[1], velocity, rtol=1e-6)
    np.testing.assert_allclose(x[2], (b * velocity + c) / k, rtol=1e-6)


def test_with_friction_it_agrees_with_a_general_integrator():
    truth, voltage = motors(1), np.repeat([3.0, -3.0, 1.0], 40)[None]
    found, x = truth.respond(voltage)[:, 0, 0], np.zeros(3)
    R, L, k, J, b, c = (
        float(p[0])
        for p in (
            truth.resistance,
            truth.inductance,
            truth.torque_constant,
            truth.inertia,
            truth.viscous,
            truth.coulomb,
        )
    )
    for n, v in enumerate(voltage[0]):
        assert np.all(np.abs(found[:, n] - x) < 1e-3 * np.abs(found).max(axis=1))

        def rhs(_, s, v=v):
            return [s[1], (k * s[2] - b * s[1] - c * np.tanh(s[1])) / J, (v - R * s[2] - k * s[1]) / L]

        x = solve_ivp(rhs, (0, DcMotorTruth.sample_period_s), x, rtol=1e-9, atol=1e-12).y[:, -1]


def test_the_amplifier_limits_the_current_and_nothing_else_exceeds_it():
    truth = motors()
    found = truth.respond(np.repeat([12.0, -12.0], 300)[None])
    assert np.abs(found[2]).max() == DcMotorTruth.current_limit_a
    assert np.all(found[2, :, 0, 305] == -DcMotorTruth.current_limit_a)  # 24 V across 1 ohm would be 24 A


def test_the_outlier_loses_more_of_its_voltage_to_friction():
    truth = motors(outlier=True, spread=0.0)
    friction = truth.coulomb * truth.resistance / truth.torque_constant  # volts that it costs
    assert friction[0] > 3 * friction[1]
    assert truth.coulomb[0] == pytest.approx(np.e * truth.coulomb[1])


def test_pendulums_agree_with_a_general_integrator():
    simulated = PendulumPopulation(n_units=1, n_episodes=1, seconds=3.0, seed=2).simulate()
    truth, recorded = simulated.truth, simulated.population.read(simulated.population.episodes[0])
    x = np.zeros(2)
    for k, torque in enumerate(recorded[:, 2]):
        assert recorded[k, 0] == pytest.approx(x[0], abs=1e-3)  # the encoder's resolution is 1.5 mrad
        assert recorded[k, 1] == pytest.approx(x[1], abs=0.06)  # six standard deviations of the noise

        def rhs(_, s, torque=torque):
            return [s[1], -truth.gravity[0] * np.sin(s[0]) - truth.damping[0] * s[1] + truth.gain[0] * torque]

        x = solve_ivp(rhs, (0, 0.01), x, rtol=1e-9, atol=1e-12).y[:, -1]
