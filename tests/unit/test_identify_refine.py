"""Pieces of the refinement: options, segments, search, stability."""

from __future__ import annotations

import numpy as np
import pytest

from kros import from_arrays
from kros.core import DataError
from kros.data import Channel, EpisodeKey, Population, Role
from kros.identify.refine import GaussNewton
from kros.identify.refine.segments import Segments, held_segments, read_segments


def population(lengths: list[int]) -> tuple[Population, dict]:
    """One unit whose episode e counts up from 1000 e."""
    data = {
        EpisodeKey("u", "default", str(e)): (1000.0 * e + np.arange(n))[:, None] * [1.0, -1.0]
        for e, n in enumerate(lengths)
    }
    return from_arrays(data, (Channel("x", Role.STATE), Channel("u", Role.INPUT)), 1.0), {"u": tuple(data)}


def test_segments_hold_the_last_episode_at_the_end() -> None:
    made, keys = population([50, 50, 50, 50])
    segments = read_segments(made, keys, horizon=10, count=8, seed=0)
    episodes = segments.states[0, 0, 0] // 1000
    assert held_segments(8, keys) == 2
    np.testing.assert_array_equal(episodes, [0, 1, 2, 0, 1, 2, 3, 3])
    np.testing.assert_array_equal(np.diff(segments.states[:, 0, 0], axis=0), 1.0)
    np.testing.assert_array_equal(segments.inputs, -segments.states)


def test_short_episodes_are_padded_and_marked() -> None:
    made, keys = population([6, 50])
    segments = read_segments(made, keys, horizon=10, count=2, seed=0)
    np.testing.assert_array_equal(segments.valid[:, 0, 0], np.arange(11) < 6)
    assert segments.valid[:, 0, 1].all()


def test_segments_begin_with_the_history() -> None:
    made, keys = population([50, 6])
    segments = read_segments(made, keys, horizon=10, count=2, seed=0, history=3)
    assert (segments.states.shape[0], segments.horizon, segments.compared.shape) == (14, 10, (10, 1, 2))
    np.testing.assert_array_equal(np.diff(segments.states[:, 0, 0, 0]), 1.0)
    np.testing.assert_array_equal(segments.compared[:, 0, 1], np.arange(10) < 2)  # six samples, four of them given
    assert segments.first(1).history == segments.units(np.array([0])).history == 3


def test_pieces_share_history_and_nothing_that_is_compared() -> None:
    states = np.arange(22.0).reshape(22, 1, 1, 1).repeat(3, axis=3)
    pieces = Segments(states, states, np.ones((22, 1, 3), bool), 2).cut(4)
    np.testing.assert_array_equal(pieces.states[0, 0, 0], [0, 10, 15])  # of pieces from 0, 5, 10, 15 in every segment
    assert (pieces.horizon, pieces.history) == (4, 2)


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
