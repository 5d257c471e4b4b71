"""Balanced truncation against Lyapunov equations, and roots of Gramians against closed forms."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from kros.core import StateSpace, block_diagonal, hinf_norm
from kros.core.norms import gramian_root
from kros.synthesis import GeneralizedPlant
from kros.synthesis.mixed_norms.mixed import truncate


def random_plant(rng, n=5):
    A = rng.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    shapes = ((n, 3), (n, 2), (3, n), (2, n), (3, 3), (3, 2), (2, 3))
    return GeneralizedPlant(A, *(rng.standard_normal(s) for s in shapes), 0.1 * rng.standard_normal((2, 2)), 1.0)


@pytest.mark.parametrize("distance", [1e-2, 1e-6, 1e-10])
def test_root_of_the_gramian_keeps_its_digits_near_the_circle(distance):
    a, b = 1 - distance, np.array([[1.0, 0.5]])
    R = gramian_root(np.array([[a]]), b)
    exact = 1.25 / ((1 - a) * (1 + a))
    assert float(R[0] @ R[0]) == pytest.approx(exact, rel=1e-12 + 2e-16 / distance), (
        "as many digits as rounding a to a double leaves"
    )


def test_truncation_error_is_within_twice_the_tail():
    rng = np.random.default_rng(0)
    for _ in range(5):
        plant = random_plant(rng, 6)
        system = plant.open_loop()
        P, Q = (
            solve_discrete_lyapunov(system.A, system.B @ system.B.T),
            solve_discrete_lyapunov(system.A.T, system.C.T @ system.C),
        )
        hankel = np.sqrt(np.sort(np.linalg.eigvals(P @ Q).real)[::-1])
        for k in range(1, 6):
            small, tail = truncate(plant, k)
            assert tail * hankel[0] == pytest.approx(hankel[k:].sum(), rel=1e-7)
            reduced = small.open_loop()
            A = block_diagonal([system, reduced]).A
            B, C = np.vstack([system.B, reduced.B]), np.hstack([system.C, -reduced.C])
            error = StateSpace(A, B, C, system.D - reduced.D, 1.0)
            assert hinf_norm(error) <= 2 * hankel[k:].sum() * (1 + 1e-6)
