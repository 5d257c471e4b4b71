"""H2 synthesis against published numbers and closed forms; `test_synthesis_solved_cases.py` has continuous time."""

from dataclasses import replace

import numpy as np
import pytest
from slicot import slicot_discrete

from kros.synthesis import GeneralizedPlant, h2, kalman


def test_slicot_example():
    plant, expected = slicot_discrete()
    found = h2(plant).controller
    for name in "ABCD":
        assert getattr(found, name) == pytest.approx(np.array(expected[name]), abs=6e-5)  # four decimals are printed
    # The feedthrough from w to z matters for a proper controller: without it the numbers are others.
    strictly = replace(plant, D11=0 * plant.D11)
    assert np.abs(h2(strictly).controller.A - np.array(expected["A"])).max() > 2e-4


def test_lqg_scalar_closed_form():
    # x+ = a x + w + u, z = (x, u), y = x + v: both Riccati equations are X = a^2 X / (1 + X) + 1.
    a = 0.9
    X = (a**2 + np.sqrt(a**4 + 4)) / 2
    plant = GeneralizedPlant(
        [[a]], [[1.0, 0]], [[1.0]], [[1.0], [0]], [[1.0]], np.zeros((2, 2)), [[0], [1.0]], [[0, 1.0]], [[0]], 1.0
    )
    found = h2(plant)
    filtered = X / (1 + X)  # variance after the measurement
    # cost = tr(X W) + (F^2 R_b) * filtered variance, with W = 1, F = -a X / (1 + X), R_b = 1 + X
    assert found.h2_norm**2 == pytest.approx(X + (a * X / (1 + X)) ** 2 * (1 + X) * filtered)


def test_kalman_scalar_closed_form_and_simulation():
    q, r = 1.0, 2.0
    found = kalman([[1.0]], [[1.0]], [[q]], [[r]])
    P = (q + np.sqrt(q**2 + 4 * q * r)) / 2
    assert found.controller.D[0, 0] == pytest.approx(P / (P + r))
    assert found.h2_norm == pytest.approx(np.sqrt(P))
