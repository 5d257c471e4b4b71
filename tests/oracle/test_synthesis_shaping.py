"""Shaping filters of a worst case touch their spectra from above."""

from __future__ import annotations

from functools import partial

import numpy as np

from kros.synthesis.worst_case.worst_case_h2 import filters
from kros.uncertainty import fit_magnitude

DT = 1e-3
FIT = partial(fit_magnitude, max_order=3, tolerance_db=0.5)


def test_filters_touch_their_spectra_from_above() -> None:
    freqs = np.geomspace(1e-3, 0.5 / DT, 400)
    corner = freqs[:, None] / np.array([20.0, 3.0])
    phi = np.array([4.0, 1e-6]) / (1 + corner**2) + np.array([0.01, 2e-9])
    response = filters(phi, freqs, DT, 3, 0.5).frequency_response(freqs)
    ratio = np.abs(np.diagonal(response, axis1=1, axis2=2)) ** 2 / phi
    np.testing.assert_allclose(ratio.min(axis=0), 1.0, rtol=1e-9)
    overbounds = [FIT(freqs, np.sqrt(column), DT).overbound_db for column in phi.T]
    np.testing.assert_allclose(10 * np.log10(ratio.max(axis=0)), overbounds, atol=0.05)
