"""Delays against signals that are delayed by a known amount, and against the best of all delays found by brute force."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from kros.evaluate.errors import delay_samples, true_errors

N = 3000


def tone(k, kinds):
    """Smooth signals with a mean, a trend and no common period, at times of any kind, shape (len(k), len(kinds))."""
    return np.stack([2.0 + 1e-3 * k + np.sin(0.031 * k + c) + 0.3 * np.cos(0.17 * k + 2 * c) for c in kinds], axis=-1)


@pytest.mark.parametrize("late", [0.0, 0.3, 1.5, 12.25, -3.8])
def test_a_delayed_signal_is_late_by_its_delay(late):
    k, kinds = np.arange(N), (0.0, 1.0, 2.0)
    found = delay_samples(tone(k - late, kinds), tone(k, kinds))
    np.testing.assert_allclose(found, late, atol=2e-3)


def test_the_delay_is_the_least_squares_one():
    """Also of a signal that is no delayed copy: filtered and noisy."""
    rng, k = np.random.default_rng(1), np.arange(N)
    x = tone(k, [0.5])[:, 0]
    y = np.convolve(x, 0.2 * 0.8 ** np.arange(60))[:N] + 0.05 * rng.standard_normal(N)
    spline, inside = CubicSpline(k, x), np.arange(200, N - 200)
    best = minimize_scalar(lambda d: np.sum((y[inside] - spline(inside - d)) ** 2), bounds=(0, 20), method="bounded")
    assert delay_samples(y, x) == pytest.approx(best.x, abs=0.02)


def test_what_has_no_delay_is_unknown_and_behind_an_episode_nothing_counts():
    k, kinds = np.arange(N), (0.0, 1.0, 2.0, 3.0)
    x, y = tone(k, kinds), tone(k - 2.5, kinds)
    y[7, 1], x[:, 2], lengths = np.nan, 4.0, np.array([N, N, N, 2000])
    x[2000:, 3], y[2000:, 3] = 1e6, -1e6
    found = true_errors(y[..., None], x[..., None], lengths, dt=0.01)
    np.testing.assert_allclose(found["true_lag_s"][:, 0], [0.025, np.nan, np.nan, 0.025], atol=2e-5)
    error = y[:2000, 3] - x[:2000, 3]
    assert found["true_rms"][3, 0] == pytest.approx(np.sqrt(np.mean(error**2)))
    largest = np.abs(x[:2000, 3]).max()
    assert found["true_error_percent"][3, 0] == pytest.approx(100 * found["true_rms"][3, 0] / largest)
    assert np.isnan(delay_samples(np.exp(-(((k - 2500) / 90.0) ** 2)), np.exp(-(((k - 500) / 90.0) ** 2))))
