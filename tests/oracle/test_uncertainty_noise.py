"""Variation against noise: static systems whose shares are known, and recordings of identical and of different systems."""

from __future__ import annotations

import numpy as np
import pytest

from kros.core.linalg import qr_triangle
from kros.identify import KoopmanMatrices
from kros.identify.edmd import ModelSamples, bootstrap_edmd, episode_weights
from kros.uncertainty import Form
from kros.uncertainty.noise import noise_share

DT = 1e-2
FREQS = np.geomspace(0.1, 40.0, 12)
ONE = np.ones((1, 1))


def static(variation: float, noise: float, units: int = 200, draws: int = 50, seed: int = 0) -> ModelSamples:
    """``G = B / z``: the squared residual is that of B at every frequency, so the share of noise is its share of the variance."""
    rng = np.random.default_rng(seed)
    truth = np.array([[5.0, 1.0], [1.0, 4.0]]) + variation * rng.normal(size=(units, 2, 2))
    B = truth + noise * rng.normal(size=truth.shape)
    samples = B[:, None] + noise * rng.normal(size=(units, draws, 2, 2))
    A = np.zeros((units, 2, 2))
    return ModelSamples(KoopmanMatrices(A, B), KoopmanMatrices(np.zeros_like(samples), samples))


@pytest.mark.parametrize("form", list(Form))
@pytest.mark.parametrize(("variation", "noise"), [(0.0, 0.02), (0.02, 0.02), (0.05, 0.0)])
def test_static_shares(form: Form, variation: float, noise: float) -> None:
    """The mean square of 200 units has 4 x 199 degrees of freedom: 5 percent standard deviation of the ratio, less for both together."""
    found = noise_share(static(variation, noise), ONE, FREQS[::6], DT, form)  # alike at every frequency
    expected = noise**2 / (noise**2 + variation**2)
    assert found.ratio == pytest.approx(np.full(2, expected), rel=0.15, abs=1e-12)
    assert 0 <= found.facts()["median"] <= 1


@pytest.mark.parametrize("units", [2, 3, 5])
def test_total_and_noise_are_means_over_pairs(units: int) -> None:
    """Few units, additive, all pairs by hand: a mean over all ordered pairs of different units, and of different draws of the same unit."""
    models = static(0.5, 0.1, units=units, draws=4)
    found = noise_share(models, ONE, FREQS, DT, Form.ADDITIVE)
    B, drawn = models.estimate.B, models.samples.B
    pairs = [np.sum((B[i] - B[k]) ** 2) for i in range(units) for k in range(units) if i != k]
    np.testing.assert_allclose(found.total, np.mean(pairs), rtol=1e-12)
    within = [np.sum((drawn[i, d] - drawn[i, d - 1]) ** 2) for i in range(units) for d in range(4)]
    np.testing.assert_allclose(found.noise, np.mean(within), rtol=1e-12)


def recordings(spread: float, units: int = 10, episodes: int = 12, seed: int = 2) -> ModelSamples:
    """Resampled models of noisy first-order systems, of the same one where `spread` is zero."""
    rng = np.random.default_rng(seed)
    R = np.empty((units, episodes, 3, 3))
    for i in range(units):
        a, b = 0.9 + spread * 0.05 * rng.uniform(-1, 1), 1.0 + spread * rng.normal()
        for e in range(episodes):
            u, w = rng.normal(size=301), 0.3 * rng.normal(size=301)
            x = np.zeros(301)
            for t in range(300):
                x[t + 1] = a * x[t] + b * u[t] + w[t]
            R[i, e] = qr_triangle(np.column_stack([x[:-1], u[:-1], x[1:]]))
    return bootstrap_edmd(R, 1, 0.0, episode_weights([episodes] * units, 100, seed))


def test_identical_systems_are_all_noise_and_different_ones_hardly() -> None:
    """Ten units leave the ratio of a scalar response scattered by up to sqrt(2 / 9) = 47 percent, 2 degrees of freedom where it is complex."""
    same = noise_share(recordings(0.0), ONE, FREQS, DT, Form.ADDITIVE)
    assert np.all((same.ratio > 0.4) & (same.ratio < 2.5))
    assert 0.6 < np.exp(np.log(same.ratio).mean()) < 1.7
    different = noise_share(recordings(0.3), ONE, FREQS, DT, Form.ADDITIVE)
    assert np.all(different.ratio < 0.05)
