"""Estimates that diverge spoil no other spectrum."""

from __future__ import annotations

import numpy as np

from kros.evaluate.errors import errors_of

DT = 1e-3


def test_a_diverged_estimate_spoils_no_other_spectrum() -> None:
    truth, estimate = np.zeros((2000, 2, 1)), np.random.default_rng(3).normal(size=(2000, 2, 1))
    estimate[1000:, 0] = np.inf
    band = 10.0, 100.0
    alone = errors_of(estimate[:, 1:], truth[:, 1:], np.array([2000]), DT, band)["gearbox_band_power"]
    both = errors_of(estimate, truth, np.array([2000, 2000]), DT, band)["gearbox_band_power"]
    assert not np.isfinite(both[0]).any()
    np.testing.assert_allclose(both[1:], alone, rtol=1e-12)
