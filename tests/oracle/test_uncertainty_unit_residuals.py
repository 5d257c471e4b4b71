"""Residuals of units beside weights, and overbounds over order: static systems counted by hand, systems of known order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kros.core.lti import gain
from kros.uncertainty import Cover, Form, Weight
from kros.uncertainty.unit_residuals import UnitResiduals, unit_residuals, unstructured_excess, weight_ratio
from kros.uncertainty.weights.cover import Structure

DT = 1e-2
FREQS = np.geomspace(0.01, 50.0, 30)
DELTAS = np.array(
    [[[0.0, 0.0], [0.0, 0.0]], [[0.3, 0.0], [0.0, 0.1]], [[0.0, 0.2], [0.2, 0.0]], [[0.9, 0.0], [0.0, 0.9]]]
)
NAMES = ("nominal", "a", "b", "out")


def static() -> UnitResiduals:
    """Additive residuals are the deltas at every frequency; the last unit is not covered."""
    responses = np.eye(2) + np.broadcast_to(DELTAS[:, None], (4, len(FREQS), 2, 2)) + 0j
    cover = Cover(np.full((len(FREQS), 2), 0.3), np.ones((len(FREQS), 2)))
    return unit_residuals(
        Form.ADDITIVE, responses[0], responses, cover, FREQS, DT, unit_ids=NAMES, nominal_id="nominal", outside=["out"]
    )


def test_static_residuals() -> None:
    found = static()
    assert found.entries == pytest.approx(np.abs(DELTAS)[:, None] * np.ones((1, len(FREQS), 1, 1)))
    assert found.ratio[:, 0] == pytest.approx([0.0, 1.0, 2 / 3, 3.0])
    assert found.largest[0] == pytest.approx(
        np.array([[0.3, 0.2], [0.2, 0.1]])
    )  # without the unit that need not be covered
    assert found.entry_weights == pytest.approx(found.largest, rel=1e-6)
    assert np.all(found.entry_weights >= found.largest)
    assert not found.entry_orders.any()
    assert (found.rows(inside=True), found.rows(inside=False)) == ([0, 1, 2], [3])


def test_entries_that_are_bounded_do_not_bound_the_perturbation() -> None:
    """W = [[0.3, 0.2], [0.2, 0.1]] bounds every entry; its determinant is -0.01, and sigma_max(W^-1 E) is counted by NumPy alone."""
    found = static()
    W = np.array([[0.3, 0.2], [0.2, 0.1]])
    worst = max(np.linalg.svd(np.linalg.inv(W) @ E, compute_uv=False)[0] for E in DELTAS[:3])
    assert found.entry_excess == pytest.approx(worst, rel=1e-5)
    assert worst > 5
    assert np.isnan(unstructured_excess(np.ones((3, 2, 1)), np.ones((1, 3, 2, 1))))
    assert np.isnan(unstructured_excess(np.ones((3, 2, 2)), np.ones((1, 3, 2, 2))))  # singular everywhere


def test_ratio_of_any_structure() -> None:
    rng = np.random.default_rng(1)
    E = rng.normal(size=(3, 5, 2, 2)) + 1j * rng.normal(size=(3, 5, 2, 2))
    freqs = FREQS[:5]
    L, R = np.diag([2.0, 3.0]), np.diag([0.5, 1.0])
    diagonal = Weight(gain(L, DT), gain(R, DT), (0, 0), (0, 0), Structure.DIAGONAL, 1.0, 0.0)
    expected = np.linalg.norm(np.linalg.inv(L) @ E @ np.linalg.inv(R), 2, axis=(-2, -1))
    assert weight_ratio(diagonal, E, freqs) == pytest.approx(expected)
    cover = Cover(np.tile([2.0, 3.0], (5, 1)), np.tile([0.5, 1.0], (5, 1)))
    assert weight_ratio(cover, E, freqs) == pytest.approx(expected)


def test_round_trips(tmp_path: Path) -> None:
    found = static()
    found.save(tmp_path / "units")
    again = UnitResiduals.load(tmp_path / "units")
    assert (again.form, again.unit_ids, again.outside, again.entry_excess) == (
        found.form,
        found.unit_ids,
        found.outside,
        found.entry_excess,
    )
    np.testing.assert_array_equal(again.ratio, found.ratio)
