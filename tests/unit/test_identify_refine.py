"""Pieces of the refinement: options, segments, search, stability."""

from __future__ import annotations

import numpy as np
import pytest

from kros import from_arrays
from kros.core import DataError
from kros.data import Channel, EpisodeKey, Population, Role
from kros.identify.refine import GaussNewton
from kros.identify.refine.segments import read_segments


def population(lengths: list[int]) -> tuple[Population, dict]:
    """One unit whose episode e counts up from 1000 e."""
    data = {
        EpisodeKey("u", "default", str(e)): (1000.0 * e + np.arange(n))[:, None] * [1.0, -1.0]
        for e, n in enumerate(lengths)
    }
    return from_arrays(data, (Channel("x", Role.STATE), Channel("u", Role.INPUT)), 1.0), {"u": tuple(data)}


def test_unit_without_training_episodes_is_named() -> None:
    made, _ = population([50])
    with pytest.raises(DataError, match="unit u has no training episode"):
        read_segments(made, {"u": ()}, 5, 2, 0)


def test_search_stays_within_the_constraint_and_finds_both_minima() -> None:
    """min (v - t)^2 for t = 1 and 5, with v <= 2."""
    target = np.array([1.0, 5.0])

    def evaluate(V: np.ndarray) -> np.ndarray:
        rest = target - V[:, 0, 0]
        J = np.stack([np.ones(2), rest], axis=1)
        return J[:, :, None] * J[:, None, :]

    search = GaussNewton(iterations=60, least_gain=1e-12)
    solution = search.minimise(evaluate, lambda V: V[:, 0, 0] <= 2.0, np.zeros((2, 1, 1)))
    assert solution.V[0, 0, 0] == pytest.approx(1.0, abs=1e-6)
    assert 1.5 < solution.V[1, 0, 0] <= 2.0
