"""The next unit's bound against what order statistics say exactly."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from kros.evaluate.over_units import draw_reserve, fewest_units, next_unit_bound


@pytest.mark.parametrize(
    ("confidence", "fewest"), [(0.95, 19), (0.9, 9), (0.99, 99), (0.5, 1), (0.8, 4), (0.75, 3), (2 / 3, 2)]
)
def test_fewer_units_than_the_confidence_needs_bound_nothing(confidence, fewest):
    errors = np.arange(float(fewest))[:, None]
    assert fewest_units(confidence) == fewest
    assert next_unit_bound(errors[1:], [1.0], confidence) is None
    assert next_unit_bound(errors, [1.0], confidence) == pytest.approx([fewest - 1])  # the largest of them


@pytest.mark.parametrize(
    ("n", "confidence", "rank"), [(19, 0.95, 19), (39, 0.95, 38), (20, 0.95, 20), (30, 0.9, 28), (9, 0.9, 9)]
)
def test_the_share_of_next_units_below_the_bound_has_the_distribution_of_an_order_statistic(n, confidence, rank):
    """Of uniform errors the bound is its own coverage: Beta(rank, n + 1 - rank), whose mean is at least the confidence."""
    rng = np.random.default_rng(n)
    covered = [next_unit_bound(rng.uniform(size=(n, 1)), [1.0], confidence)[0] for _ in range(4000)]
    exact = stats.beta(rank, n + 1 - rank)
    assert stats.kstest(covered, exact.cdf).pvalue > 0.01
    assert confidence <= exact.mean() + 1e-12 < confidence + 1 / (n + 1) + 1e-9


def test_errors_are_bounded_together_by_the_largest_scaled_one():
    errors = np.array([[1.0, 10.0], [2.0, 70.0], [6.0, 20.0], [4.0, 10.0]])  # scaled by (2, 20): 0.5, 3.5, 3, 2
    assert next_unit_bound(errors, [2.0, 20.0], 0.8) == pytest.approx([7.0, 70.0])
    assert next_unit_bound(errors, [2.0, 20.0], 0.6) == pytest.approx([6.0, 60.0])
    assert np.isinf(next_unit_bound([[1.0], [np.nan], [2.0], [3.0]], [1.0], 0.8)).all()
    assert next_unit_bound([[1.0], [np.nan], [2.0], [3.0]], [1.0], 0.6) == pytest.approx([3.0])


def test_the_draw_knows_places_alone_and_grows():
    units = [f"u{i}" for i in range(40)]
    drawn = [set(draw_reserve(units, n)) for n in range(41)]
    assert [len(d) for d in drawn] == list(range(41))
    assert all(small < large for small, large in pairwise(drawn))
    assert drawn[7] == {units[int(name[1:])] for name in draw_reserve([f"v{i}" for i in range(40)], 7)}
    first = [draw_reserve(units[:5], 1, seed)[0] for seed in range(2000)]
    assert stats.chisquare([first.count(u) for u in units[:5]]).pvalue > 0.01
