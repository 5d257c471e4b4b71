"""EDMD against exact systems, on data where normal equations fail, and its resampled models against repeated experiments."""

from __future__ import annotations

import numpy as np
import pytest

from kros.core.errors import IdentificationError
from kros.identify import Factor, combine, edmd, smallest_stabilising_alpha
from kros.identify.edmd import bootstrap_edmd, episode_weights
from kros.identify.factors import lifted_factor, reduce_episode
from kros.lifting import Lifting

LIFTING = Lifting(("position", "velocity"), ("sin(3*position + phase)",), ("phase",))
A_TRUE = np.array([[0.9, 0.1, 0.02], [-0.05, 0.8, 0.1]])
B_TRUE = np.array([[0.01, 0.0], [0.1, -0.2]])


def simulate(seed, n_samples=400, phase=0.7, noise=0.0):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n_samples, 2))
    x = np.zeros((n_samples, 2))
    for k in range(n_samples - 1):
        lifted = np.array([x[k, 0], x[k, 1], np.sin(3 * x[k, 0] + phase)])
        x[k + 1] = A_TRUE @ lifted + B_TRUE @ u[k] + noise * rng.normal(size=2)
    return x, u


def stack(factors):
    return Factor(*(np.stack([getattr(f, name) for f in factors]) for name in ("R", "peak", "n_samples")))


def lifted_R(episodes, phase=0.7, model=LIFTING):
    factor = combine(stack([reduce_episode(x, u, LIFTING) for x, u in episodes]))
    batch = Factor(*(np.asarray(getattr(factor, name))[None] for name in ("R", "peak", "n_samples")))
    return lifted_factor(batch, LIFTING, {"phase": np.array([phase])}, model)


def test_exact_system_is_recovered_to_rounding():
    found = edmd(lifted_R([simulate(0), simulate(1)]).R[0], 3)
    np.testing.assert_allclose(found.A[:2], A_TRUE, atol=1e-13)
    np.testing.assert_allclose(found.B[:2], B_TRUE, atol=1e-13)


@pytest.mark.parametrize("scale", [1e-6, 1e-7, 1e-8, 1e-9, 1e-12])
def test_badly_scaled_states_are_identified(scale):
    """Two decoupled states scaled 1 : s; the normal equations of (32) return 0 for the second one at s = 1e-8."""
    rng = np.random.default_rng(5)
    u = rng.normal(size=(500, 2))
    x = np.zeros((500, 2))
    for k in range(499):
        x[k + 1] = [0.9 * x[k, 0] + u[k, 0], 0.5 * x[k, 1] + u[k, 1]]
    lifting = Lifting(("a", "b"))
    found = edmd(reduce_episode(x * [1.0, scale], u, lifting).R, 2)
    np.testing.assert_allclose(np.diag(found.A), [0.9, 0.5], rtol=1e-12)


def test_a_new_phase_needs_no_second_pass():
    x, u = simulate(7, noise=0.05)
    for phase in (0.0, 1.3, 4.0):
        direct = reduce_episode(x, u, Lifting(("position", "velocity"), (f"sin(3*position + {phase})",)))
        theta = np.column_stack([x, np.sin(3 * x[:, 0] + phase)])
        U = np.linalg.lstsq(np.hstack([theta, u])[:-1], theta[1:], rcond=None)[0].T
        found = edmd(lifted_R([(x, u)], phase).R[0], 3)
        np.testing.assert_allclose(np.hstack([found.A, found.B]), U, rtol=1e-8, atol=1e-10)
        assert direct.n_samples == len(x) - 1


@pytest.mark.parametrize("seed", range(4))
def test_smallest_alpha_is_that_of_a_search_over_all_models_of_all_units(seed):
    """One regularisation after the other, from above, and then halved, each by QR of the regularised data; units turn
    unstable at their own."""
    rng = np.random.default_rng(seed)
    factors = []
    for n in (2, 3):
        R = np.triu(rng.normal(size=(6, 2 * n + 1, 2 * n + 1)))
        R[:, :n, n + 1 :] = R[:, :n, :n] @ (
            rng.uniform(0.9, 1.1, size=(6, 1, 1)) * np.linalg.qr(rng.normal(size=(6, n, n)))[0]
        )
        factors.append((R, n))

    def stable(exponent):
        return all(np.all(edmd(R, n, 10**exponent).spectral_radius() < 1 - 1e-3) for R, n in factors)

    high = next(e for e in np.arange(4.0, -12.0, -0.1) if not stable(e)) + 0.1
    low = high - 0.1
    for _ in range(40):
        low, high = (low, (low + high) / 2) if stable((low + high) / 2) else ((low + high) / 2, high)
    assert smallest_stabilising_alpha(factors, 1e-3) == pytest.approx(10**high, rel=1e-6)


def test_dependent_columns_are_named():
    x, u = simulate(10)
    with pytest.raises(IdentificationError, match="depends on the others"):
        edmd(reduce_episode(x, np.column_stack([u[:, 0], 2 * u[:, 0]]), Lifting(("position", "velocity"))).R, 2)


ROWS_TRUE = np.array([[0.8, 0.3, 0.0], [-0.3, 0.7, 0.5]])


def data_sets(count: int, episodes: int, samples: int, seed: int) -> np.ndarray:
    """Factors of [Psi | Theta_plus] of independently simulated data sets, (data set, episode, 5, 5), white process
    noise."""
    rng = np.random.default_rng(seed)
    x = np.zeros((samples, count, episodes, 2))
    x[0] = rng.normal(size=x.shape[1:])
    u = rng.normal(size=(samples, count, episodes, 1))
    for k in range(samples - 1):
        x[k + 1] = np.concatenate([x[k], u[k]], axis=-1) @ ROWS_TRUE.T + 0.3 * rng.normal(size=x.shape[1:])
    rows = np.concatenate([x[:-1], u[:-1], x[1:]], axis=-1)
    return np.linalg.qr(np.moveaxis(rows, 0, 2), mode="r")


@pytest.mark.parametrize("alpha", [0.0, 200.0])
def test_covariance_of_resampled_models_is_that_of_repeated_experiments(alpha: float) -> None:
    """Units stand for experiments. 1500 of them know a variance to 3.7 percent and a correlation to 0.026 (one
    standard error)."""
    R = data_sets(1500, 12, 60, seed=0)
    models = bootstrap_edmd(R, 2, alpha, episode_weights([12] * 1500, 60, seed=1))
    W = np.concatenate([models.samples.A, models.samples.B], axis=-1).reshape(1500, 60, -1)
    W = W - W.mean(axis=1, keepdims=True)
    estimates = np.concatenate([models.estimate.A, models.estimate.B], axis=-1).reshape(1500, -1)
    repeated, found = np.cov(estimates.T), np.einsum("uda,udb->ab", W, W) / (59 * 1500)
    scale = np.sqrt(np.diagonal(repeated))
    np.testing.assert_allclose(np.diagonal(found), np.diagonal(repeated), rtol=4 * np.sqrt(2 / 1499))
    np.testing.assert_allclose(
        found / np.outer(scale, scale), repeated / np.outer(scale, scale), atol=4 * np.sqrt(2 / 1499)
    )
