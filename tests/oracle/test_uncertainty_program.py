"""Small linear programs against HiGHS."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

from kros.uncertainty.weights.programs import minimised as solve


def programs(seed: int, n: int, rows: int, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Fits of a smooth function in the largest error, each of a function a little different from the one before."""
    rng, x = np.random.default_rng(seed), np.linspace(-1, 1, rows)
    phi = np.vander(x, n - 2)
    found = []
    for k in range(count):
        y = np.exp(x * rng.normal()) + 0.1 * np.sin((3 + 0.05 * k) * x)
        A = np.vstack([np.hstack([s * phi, -s * y[:, None], -np.ones((rows, 1))]) for s in (1, -1)])
        found.append((A / np.abs(A).max(axis=1, keepdims=True), np.eye(n)[n - 2]))
    return found


@pytest.mark.parametrize("n", [3, 6, 9])
def test_values_are_those_of_highs_from_nothing_and_from_the_program_before(n: int) -> None:
    active = None
    for A, g in programs(n, n, 60, 5):
        c = np.eye(n)[-1]
        known = linprog(
            c, A_ub=A, b_ub=np.zeros(len(A)), A_eq=g[None], b_eq=[1.0], bounds=[(None, None)] * n, method="highs"
        )
        for start in (None, active):
            found = solve(A, g, start)
            assert found is not None
            x, active = found
            assert (A @ x).max() < 1e-9
            assert abs(g @ x - 1) < 1e-9
            assert x[-1] == pytest.approx(known.fun, abs=1e-7)
            assert np.abs(A[active] @ x).max() < 1e-9


def test_programs_without_a_bound_or_without_a_solution_have_none() -> None:
    g = np.array([1.0, 0.0, 0.0])
    assert solve(np.array([[1.0, 1.0, 0.0], [0.0, -1.0, 0.0]]), g) is None  # t falls forever
    assert (
        solve(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -1.0], [0.0, -1.0, -1.0]]), g) is None
    )  # the first unknown is one, and negative
