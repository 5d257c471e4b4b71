"""Cases whose solution is in print or in closed form, put as a stranger would put them: by the matrices of the generalized plant."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from slicot import slicot_discrete

from kros.core import StateSpace, hinf_norm
from kros.synthesis import GeneralizedPlant, Status, h2, hinf, kalman


@pytest.mark.parametrize(("q", "sigma"), [(1.0, 1.0), (60.0, 0.1), (1e4, 1e4)])
def test_lqg_without_guaranteed_margins(q, sigma):
    """J. C. Doyle, "Guaranteed margins for LQG regulators", IEEE Trans. Automatic Control 23 (1978) 756-757."""
    ones, A, e1, e2 = np.ones((2, 1)), [[1.0, 1.0], [0.0, 1.0]], np.eye(2)[:1], np.eye(2)[1:]
    B1, C1 = np.sqrt(sigma) * ones @ e1, np.sqrt(q) * e1.T @ ones.T
    plant = GeneralizedPlant(A, B1, e2.T, C1, e1, np.zeros((2, 2)), e2.T, e2, [[0.0]], 0.0)
    K = h2(plant).controller
    assert pytest.approx(-(2 + np.sqrt(4 + q)) * ones.T, rel=1e-6) == K.C
    assert pytest.approx((2 + np.sqrt(4 + sigma)) * ones, rel=1e-6) == K.B


def siso(numerator, *denominators):
    """Product of ``numerator`` and first-order lags as matrices."""
    system = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[numerator]], 0.0)
    for tau in denominators:
        system = StateSpace([[-1 / tau]], [[1 / tau]], [[1.0]], [[0.0]], 0.0) @ system
    return system


def performance(M, bandwidth, A):
    """``(s/M + w_B) / (s + w_B A)``."""
    return StateSpace([[-bandwidth * A]], [[1.0]], [[bandwidth * (1 - A / M)]], [[1 / M]], 0.0)


def test_mixed_sensitivity_of_the_disturbance_process():
    """S. Skogestad, I. Postlethwaite, *Multivariable Feedback Control*, 2nd edition, example 2.17, design 1: min
    ||(w_P S, K S)||_inf."""
    G, W = siso(200.0, 10.0, 0.05, 0.05), performance(1.5, 10.0, 1e-4)
    n, k = G.n_states, W.n_states
    A = block_diag(G.A, W.A) - np.block([[np.zeros((n, n + k))], [W.B @ G.C, np.zeros((k, k))]])
    B1, B2 = np.vstack([np.zeros((n, 1)), W.B]), np.vstack([G.B, np.zeros((k, 1))])
    C1, C2 = np.block([[-W.D @ G.C, W.C], [np.zeros((1, n + k))]]), np.hstack([-G.C, np.zeros((1, k))])
    plant = GeneralizedPlant(A, B1, B2, C1, C2, np.vstack([W.D, [[0.0]]]), [[0.0], [1.0]], [[1.0]], [[0.0]], 0.0)
    found = hinf(plant)
    assert found.status is Status.OPTIMAL
    assert found.hinf_norm == pytest.approx(1.37, abs=6e-3)  # two decimals are printed
    assert hinf_norm(plant.close(found.controller)) == pytest.approx(found.hinf_norm)


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
