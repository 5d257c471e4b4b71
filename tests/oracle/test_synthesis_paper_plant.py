"""Closing the loop of a generalized plant against its linear fractional transformation."""

import numpy as np
import pytest

from kros.core import StateSpace
from kros.synthesis import GeneralizedPlant


def test_close_solves_the_algebraic_loop():
    rng = np.random.default_rng(8)
    plant = GeneralizedPlant(
        *(rng.standard_normal(s) for s in ((3, 3), (3, 2), (3, 1), (2, 3), (2, 3), (2, 2), (2, 1), (2, 2))),
        0.3 * rng.standard_normal((2, 1)),
        1.0,
    )
    K = StateSpace(*map(rng.standard_normal, ((2, 2), (2, 2), (1, 2), (1, 2))), 1.0)
    freqs = np.array([0.01, 0.1, 0.37])
    P, k = plant.open_loop().frequency_response(freqs), K.frequency_response(freqs)
    P11, P12, P21, P22 = P[:, :2, :2], P[:, :2, 2:], P[:, 2:, :2], P[:, 2:, 2:]
    expected = P11 + P12 @ k @ np.linalg.solve(np.eye(2) - P22 @ k, P21)
    assert plant.close(K).frequency_response(freqs) == pytest.approx(expected)
