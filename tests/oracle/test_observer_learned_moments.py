"""Moments of the learned estimator against its regressors written out."""

import numpy as np
import pytest

from kros.observer.baselines.learned_moments import episode_moments


@pytest.mark.parametrize("taps", [1, 2, 9, 40])
@pytest.mark.parametrize("n_samples", [5, 60, 900])
def test_moments_of_an_episode_are_those_of_its_regressors(taps: int, n_samples: int) -> None:
    rng, channels = np.random.default_rng(taps), 3
    z = 1e3 + np.cumsum(rng.standard_normal((n_samples, channels)), axis=0)  # far from zero beside its steps
    truth = rng.standard_normal((n_samples, 2))
    before = np.concatenate([np.repeat(z[:1], taps, axis=0), z])  # at rest before the first sample
    at = taps + np.arange(n_samples)
    parts = [before[at - 1], *(before[at - 1 - j] - before[at - j] for j in range(1, taps))]
    X = np.column_stack([np.ones(n_samples), np.stack(parts, axis=-1).reshape(n_samples, -1)])
    gram, cross, power = episode_moments(z, truth, taps)
    size = np.sqrt(np.maximum(np.mean(X**2, axis=0), 1.0))  # of lags that few samples reach, rounding beside one step counts
    np.testing.assert_allclose(gram / size / size[:, None], X.T @ X / n_samples / size / size[:, None], rtol=0, atol=1e-12)
    np.testing.assert_allclose(cross / size[:, None], X.T @ truth / n_samples / size[:, None], rtol=0, atol=1e-12)
    np.testing.assert_allclose(power, np.mean(truth**2, axis=0))


@pytest.mark.parametrize("latest", [3, 20])
def test_lags_at_which_nothing_has_moved_yet_have_no_moments(latest: int) -> None:
    rng = np.random.default_rng(0)
    z = np.column_stack([np.cumsum(rng.standard_normal(200)), np.where(np.arange(200) < 200 - latest, 1.0, rng.standard_normal(200))])
    _, cross, _ = episode_moments(z, rng.standard_normal((200, 1)), 40)
    late = cross[1:].reshape(2, 40)[1]
    assert np.flatnonzero(late[1:]).tolist() == list(range(latest - 1))
