"""Residuals of units beside weights, and overbounds over order: static systems counted by hand, systems of known order."""

from __future__ import annotations

import numpy as np
import pytest

from kros.uncertainty import Form
from kros.uncertainty.unit_residuals import UnitResiduals, fit_entries, unit_residuals
from kros.uncertainty.weights.cover import Cover

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
    units = dict(zip(NAMES, responses, strict=True))
    return unit_residuals(Form.ADDITIVE, ("nominal", responses[0]), units, cover, FREQS, DT, outside=["out"])


def test_static_residuals() -> None:
    found = static()
    assert found.entries == pytest.approx(np.abs(DELTAS)[:, None] * np.ones((1, len(FREQS), 1, 1)))
    assert found.ratio[:, 0] == pytest.approx([0.0, 1.0, 2 / 3, 3.0])
    # without the unit that need not be covered
    assert found.largest[0] == pytest.approx(np.array([[0.3, 0.2], [0.2, 0.1]]))
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
    for shape in ((1, 3, 2, 1), (1, 3, 2, 2)):  # not square, and singular everywhere
        assert np.isnan(fit_entries(np.ones(shape), FREQS[:3], DT, 4).excess)


@pytest.mark.parametrize("shape", [(2, 2), (3, 2)])
def test_entries_have_their_own_magnitudes(shape: tuple[int, int]) -> None:
    """First-order lags of one unit that is the largest everywhere, half of them without another."""
    gains = np.random.default_rng(1).normal(size=shape)
    corners = np.exp(np.random.default_rng(2).uniform(0, 4, size=shape))
    poles = np.exp(-2 * np.pi * corners * DT)
    z = np.exp(2j * np.pi * FREQS * DT)[:, None, None]
    E = gains * (0.1 + (1 - poles) / (z - poles))
    found = fit_entries(np.array([E, 0.4 * E]), FREQS, DT, 4, 0.05)
    np.testing.assert_array_equal(found.orders, np.ones(shape))
    loose = 20 * np.log10(np.abs(found.system.frequency_response(FREQS)) / np.abs(E))
    assert loose.min() >= -1e-9
    assert loose.max() <= 0.05
