"""Covers against textbook cases, an exhaustive search, and a general convex optimiser."""

from __future__ import annotations

import numpy as np
import pytest

from kros.uncertainty.weights.cover import NEPER_DB, optimal_cover


def residuals(seed: int, units: int, freqs: int, p: int, m: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(units, freqs, p, m)) + 1j * rng.normal(size=(units, freqs, p, m))


def sound(E: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The condition of design section 7, one matrix at a time."""
    return np.array(
        [[np.linalg.norm(E[k, f] / left[f][:, None] / right[f], 2) for f in range(E.shape[1])] for k in range(len(E))]
    )


def exhaustive_cost_db(E: np.ndarray) -> float:
    """Mean log cost of the best cover of 2 x 2 residuals at one frequency, by a nested grid search over two ratios."""
    spans, centre = 12.0, np.zeros(2)
    best = np.inf
    for _ in range(9):
        x = centre[0] + np.linspace(-spans, spans, 25)
        y = centre[1] + np.linspace(-spans, spans, 25)
        X, Y = np.meshgrid(x, y, indexing="ij")
        left, right = np.exp([X / 2, -X / 2]), np.exp([Y / 2, -Y / 2])
        M = E[:, :, :, None, None] / left[:, None] / right[None, :]
        sigma = np.linalg.norm(np.moveaxis(M, (1, 2), (-2, -1)), 2, axis=(-2, -1)).max(axis=0)
        i, j = np.unravel_index(np.argmin(sigma), sigma.shape)
        best, centre, spans = min(best, sigma[i, j]), np.array([x[i], y[j]]), spans / 4
    return float(20 * np.log10(best))


@pytest.mark.parametrize("shape", [(2, 2), (4, 2), (2, 4), (3, 3), (1, 1), (4, 4)])
def test_every_cover_is_sound_and_touches(shape: tuple[int, int]) -> None:
    E = residuals(1, 5, 8, *shape)
    found = optimal_cover(E)
    ratio = sound(E, found.left, found.right)
    np.testing.assert_allclose(ratio.max(axis=0), 1.0, rtol=1e-10)
    np.testing.assert_allclose(found.ratio(E), ratio, rtol=1e-10)


def test_rank_one_residual_is_covered_by_its_dyad() -> None:
    """`E = a b^H` scaled to equal moduli has norm sqrt(p m) times the mean: cost from the closed form."""
    a, b = np.array([1.0, 30.0]), np.array([0.2, 5.0])
    E = np.outer(a, b)[None, None] + 0j
    expected = 20 * np.log10(2.0) + 10 * np.log10(a.prod()) + 10 * np.log10(b.prod())
    np.testing.assert_allclose(optimal_cover(E).cost() * NEPER_DB, expected, atol=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_two_by_two_covers_are_optimal(seed: int) -> None:
    E = residuals(seed, 6, 3, 2, 2) * 10.0 ** np.random.default_rng(seed).uniform(-1, 1, size=(1, 3, 2, 2))
    exact = [exhaustive_cost_db(E[:, f]) for f in range(3)]
    gap = optimal_cover(E).cost() * NEPER_DB - exact
    assert (gap < 0.1).all()
    assert (gap > -0.02).all()  # the resolution of the search


@pytest.mark.parametrize("shape", [(4, 2), (3, 3)])
def test_larger_covers_are_optimal(shape: tuple[int, int]) -> None:
    from scipy.optimize import minimize

    E = residuals(7, 4, 1, *shape) * np.logspace(-1, 1, shape[0])[:, None]
    p = shape[0]

    def cost(x: np.ndarray) -> float:
        M = E[:, 0] * np.exp(-x[:p])[:, None] * np.exp(-x[p:])
        return float(x[:p].mean() + x[p:].mean() + np.log(np.linalg.norm(M, 2, axis=(1, 2)).max()))

    x = np.zeros(sum(shape))
    for _ in range(6):
        x = minimize(
            cost, x, method="Nelder-Mead", options={"maxiter": 4000, "xatol": 1e-7, "fatol": 1e-9, "adaptive": True}
        ).x
    gap = optimal_cover(E).cost()[0] * NEPER_DB - 20 * np.log10(np.e) * cost(x)
    assert gap < 0.1


def test_zero_residuals_need_nothing() -> None:
    E = residuals(10, 3, 4, 2, 2)
    E[:, 1] = 0
    found = optimal_cover(E)
    assert not found.left[1].any()
    assert np.isfinite(found.left[:, :, None] * found.right[:, None, :]).all()
    assert (found.ratio(E) <= 1 + 1e-10).all()


def test_triangular_residuals_stay_finite() -> None:
    E = residuals(11, 3, 4, 2, 2)
    E[:, :, 1, 0] = 0
    found = optimal_cover(E)
    assert np.isfinite(np.log(found.left)).all()
    lower = np.log10(np.abs(E[:, :, 0, 0]).max(axis=0)) + np.log10(np.abs(E[:, :, 1, 1]).max(axis=0))
    assert (found.cost() * NEPER_DB >= 10 * lower - 1e-6).all()  # no cover can cost less than the diagonal alone
    assert (found.cost() * NEPER_DB <= 10 * lower + 0.5).all()
