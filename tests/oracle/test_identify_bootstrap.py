"""Uncertainty of the estimate against repeated experiments on a known system."""

from __future__ import annotations

from typing import Any

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


def bands(
    models: ModelSamples, freqs: np.ndarray, dt: float, output_scale: Any, input_scale: Any, level: float
) -> tuple[np.ndarray, np.ndarray]:
    """Quantiles over the draws of sigma_max of the scaled deviation, and of every entry's magnitude: (unit,
    frequency[, n, m])."""
    off = (
        np.stack([models.samples[row].responses(freqs, dt) for row in range(len(models.estimate.A))])
        - models.estimate.responses(freqs, dt)[:, None]
    )
    spectral = np.linalg.norm(off * input_scale / np.asarray(output_scale)[:, None], ord=2, axis=(-2, -1))
    return np.quantile(spectral, level, axis=1), np.quantile(np.abs(off), level, axis=1)


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


def test_bands_hold_the_truth_as_often_as_they_say() -> None:
    """800 experiments know a share of 0.9 to 0.011. Thirty episodes know a variance to 26 percent, which costs the
    band some of its
    coverage (Student's t with 29 degrees of freedom: 0.89), and the quantile of 200 draws about as much."""
    R = data_sets(800, 30, 30, seed=2)
    models = bootstrap_edmd(R, 2, 0.0, episode_weights([30] * 800, 200, seed=3))
    scale_out, scale_in = np.array([2.0, 0.5]), np.array([3.0])
    freqs = np.array([0.1, 5.0, 15.0, 45.0])
    spectral, entry = bands(models, freqs, DT, scale_out, scale_in, level=0.9)
    truth = np.array(
        [np.linalg.solve(x * np.eye(2) - TRUE[:, :2], TRUE[:, 2:]) for x in np.exp(2j * np.pi * freqs * DT)]
    )
    off = models.estimate.responses(freqs, DT) - truth
    inside = np.linalg.norm(off * scale_in / scale_out[:, None], ord=2, axis=(-2, -1)) <= spectral
    coverage = np.concatenate([inside.mean(axis=0), (np.abs(off) <= entry).mean(axis=0).ravel()])
    assert coverage.shape == (4 + 8,)
    assert coverage.min() > 0.9 - 0.02 - 4 * 0.011
    assert coverage.max() < 0.9 + 4 * 0.011
