"""H2 synthesis against published numbers, independent optimisation, FIR Youla programs, and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from slicot import slicot_discrete

from kros.core import gain
from kros.synthesis import GeneralizedPlant, h2, kalman


def random_plant(rng, n, dt, d22=True):
    shapes = ((n, n), (n, 3), (n, 2), (4, n), (2, n), (4, 3), (4, 2), (2, 3))
    return GeneralizedPlant(*map(rng.standard_normal, shapes), 0.1 * rng.standard_normal((2, 2)) * d22, dt)


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


def test_an_impulse_response_of_forty_taps_reaches_the_same_optimum():
    # A stable plant: T(Q) = P11 + P12 Q P21 is affine in a FIR Q, so least squares over its taps tends to the optimum
    # from above.
    rng = np.random.default_rng(5)
    plant = random_plant(rng, 3, 1.0, d22=False)
    A = plant.A * (0.4 / np.abs(np.linalg.eigvals(plant.A)).max())
    plant = replace(plant, A=A)
    z = np.exp(2j * np.pi * np.arange(400) / 400)

    resolvent = np.linalg.inv(z[:, None, None] * np.eye(3) - A)
    P11 = plant.C1 @ resolvent @ plant.B1 + plant.D11
    P12 = plant.C1 @ resolvent @ plant.B2 + plant.D12
    P21 = plant.C2 @ resolvent @ plant.B1 + plant.D21
    columns = []
    for tap in range(40):
        delayed = z[:, None, None] ** -tap * P12
        for i in range(2):
            columns.extend((delayed[:, :, [i]] @ P21[:, [j], :]).ravel() for j in range(2))
    design, target = np.array(columns).T, -P11.ravel()
    real = np.vstack([design.real, design.imag])
    taps, *_ = np.linalg.lstsq(real, np.concatenate([target.real, target.imag]), rcond=None)
    value = np.linalg.norm(design @ taps - target) / np.sqrt(400)
    assert value == pytest.approx(h2(plant).h2_norm, rel=1e-5)
    assert value >= h2(plant).h2_norm * (1 - 1e-9)


def test_kalman_scalar_closed_form_and_simulation():
    q, r = 1.0, 2.0
    found = kalman([[1.0]], [[1.0]], [[q]], [[r]])
    P = (q + np.sqrt(q**2 + 4 * q * r)) / 2
    assert found.controller.D[0, 0] == pytest.approx(P / (P + r))
    assert found.h2_norm == pytest.approx(np.sqrt(P))


def test_continuous_lqg_against_scipy_formula():
    # Double integrator with unit weights: X = [[sqrt 3, 1], [1, sqrt 3]], and the filter is its mirror image.
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    B1, C1 = np.eye(2, 3), np.eye(3, 2)
    plant = GeneralizedPlant(
        A, B1, B, C1, [[1.0, 0.0]], np.zeros((3, 3)), [[0], [0], [1.0]], [[0, 0, 1.0]], [[0.0]], 0.0
    )
    K = h2(plant).controller
    assert pytest.approx(np.array([[-1.0, -np.sqrt(3)]])) == K.C
    assert pytest.approx(np.array([[np.sqrt(3)], [1.0]])) == K.B
    assert not K.D.any()
    assert gain(K.D, 0.0).dt == 0
