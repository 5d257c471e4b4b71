"""The simulated pendulums against a general integrator and against their own truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kros.plants import PendulumPopulation


def test_trajectory_agrees_with_a_general_integrator():
    simulated = PendulumPopulation(n_units=1, n_episodes=1, seconds=3.0, seed=2).simulate()
    truth, recorded = simulated.truth, simulated.population.read(simulated.population.episodes[0])
    x = np.zeros(2)
    for k, torque in enumerate(recorded[:, 2]):
        assert recorded[k, 0] == pytest.approx(x[0], abs=1e-3)  # the encoder's resolution is 1.5 mrad
        assert recorded[k, 1] == pytest.approx(x[1], abs=0.06)  # six standard deviations of the noise

        def rhs(_, s, torque=torque):
            return [s[1], -truth.gravity[0] * np.sin(s[0]) - truth.damping[0] * s[1] + truth.gain[0] * torque]

        x = solve_ivp(rhs, (0, 0.01), x, rtol=1e-9, atol=1e-12).y[:, -1]


def test_regression_on_the_sine_recovers_the_parameters():
    simulated = PendulumPopulation(n_units=3, n_episodes=10, seed=3, outlier=True).simulate()
    population, truth = simulated.population, simulated.truth
    for row, unit in enumerate(population.unit_ids):
        rows, rates = [], []
        for key in population.keys(unit):
            x = population.read(key)
            # over one sample, between neighbours: exact to second order
            middle = 0.5 * (x[1:] + x[:-1])
            rows.append(np.stack([-np.sin(middle[:, 0]), -middle[:, 1], x[:-1, 2]], axis=1))
            rates.append(np.diff(x[:, 1]) / population.sample_period_s)
        found = np.linalg.lstsq(np.concatenate(rows), np.concatenate(rates), rcond=None)[0]
        np.testing.assert_allclose(found, [truth.gravity[row], truth.damping[row], truth.gain[row]], rtol=0.05)
