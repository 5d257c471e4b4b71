"""Uncertainty of the estimate against repeated experiments on a known system."""

from __future__ import annotations

import numpy as np
import pytest

from kros.identify.edmd import ModelSamples, bootstrap_edmd, episode_weights

TRUE = np.array([[0.8, 0.3, 0.0], [-0.3, 0.7, 0.5]])
DT = 0.01


def data_sets(count: int, episodes: int, samples: int, seed: int) -> np.ndarray:
    """Factors of [Psi | Theta_plus] of independently simulated data sets, (data set, episode, 5, 5), white process
    noise."""
    rng = np.random.default_rng(seed)
    x = np.zeros((samples, count, episodes, 2))
    x[0] = rng.normal(size=x.shape[1:])
    u = rng.normal(size=(samples, count, episodes, 1))
    for k in range(samples - 1):
        x[k + 1] = np.concatenate([x[k], u[k]], axis=-1) @ TRUE.T + 0.3 * rng.normal(size=x.shape[1:])
    rows = np.concatenate([x[:-1], u[:-1], x[1:]], axis=-1)
    return np.linalg.qr(np.moveaxis(rows, 0, 2), mode="r")


def of(models: ModelSamples) -> np.ndarray:
    return np.concatenate([models.estimate.A, models.estimate.B], axis=-1).reshape(len(models.estimate.A), -1)


@pytest.mark.parametrize("alpha", [0.0, 200.0])
def test_covariance_of_resampled_models_is_that_of_repeated_experiments(alpha: float) -> None:
    """Units stand for experiments. 1500 of them know a variance to 3.7 percent and a correlation to 0.026 (one
    standard error)."""
    R = data_sets(1500, 12, 60, seed=0)
    models = bootstrap_edmd(R, 2, alpha, episode_weights([12] * 1500, 60, seed=1))
    W = np.concatenate([models.samples.A, models.samples.B], axis=-1).reshape(1500, 60, -1)
    W = W - W.mean(axis=1, keepdims=True)
    repeated, found = np.cov(of(models).T), np.einsum("uda,udb->ab", W, W) / (59 * 1500)
    scale = np.sqrt(np.diagonal(repeated))
    np.testing.assert_allclose(np.diagonal(found), np.diagonal(repeated), rtol=4 * np.sqrt(2 / 1499))
    np.testing.assert_allclose(
        found / np.outer(scale, scale), repeated / np.outer(scale, scale), atol=4 * np.sqrt(2 / 1499)
    )
