"""Edges of resampling: weights, missing episodes, responses."""

from __future__ import annotations

import numpy as np
import pytest

from kros.core import DataError
from kros.identify import KoopmanMatrices
from kros.identify.edmd import ModelSamples, bootstrap_edmd, episode_weights


def factors(units: int, episodes: int, seed: int = 0) -> np.ndarray:
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(units, episodes, 30, 5)), mode="r")


def samples(units: int = 2, draws: int = 40, spread: float = 0.02) -> ModelSamples:
    rng = np.random.default_rng(1)
    A, B = np.array([[0.8, 0.1], [-0.2, 0.7]]), np.array([[0.1, 0.0], [1.0, 0.5]])
    whole = KoopmanMatrices(np.tile(A, (units, 1, 1)), np.tile(B, (units, 1, 1)))
    drawn = KoopmanMatrices(
        A + spread * rng.normal(size=(units, draws, 2, 2)), B + spread * rng.normal(size=(units, draws, 2, 2))
    )
    return ModelSamples(whole, drawn)


@pytest.mark.parametrize(("episodes", "draws"), [([3, 1], 10), ([3, 3], 1), ([], 10)])
def test_too_little_to_draw_from_is_refused(episodes: list[int], draws: int) -> None:
    with pytest.raises(DataError, match="needs two episodes of every unit"):
        episode_weights(episodes, draws, 0)


def test_a_unit_with_fewer_episodes_is_resampled_among_its_own() -> None:
    R = factors(1, 3)
    padded = np.concatenate([R, np.zeros((1, 2, 5, 5))], axis=1)
    weights = episode_weights([3], 6, 0)
    wide = np.concatenate([weights, np.zeros((1, 6, 2))], axis=2)
    np.testing.assert_allclose(
        bootstrap_edmd(padded, 2, 0.0, wide).samples.A, bootstrap_edmd(R, 2, 0.0, weights).samples.A, rtol=1e-9
    )


def test_responses_of_samples_are_those_of_their_models() -> None:
    drawn = samples()
    freqs, dt = np.array([0.0, 3.0, 50.0]), 0.01
    for unit in range(2):
        found = drawn.samples[unit].responses(freqs, dt)
        for k, z in enumerate(np.exp(2j * np.pi * freqs * dt)):
            for draw, (A, B) in enumerate(zip(drawn.samples.A[unit], drawn.samples.B[unit], strict=True)):
                np.testing.assert_allclose(found[draw, k], np.linalg.inv(z * np.eye(2) - A) @ B, rtol=1e-7)
