"""Many units."""

from __future__ import annotations

import numpy as np
import pytest

from kros.core.lti import StateSpace
from kros.identify.refine.metric import peak_residual
from kros.uncertainty import quantify, residual
from kros.uncertainty.forms import completion
from kros.uncertainty.weights.proof import ProofMethod

UNITS, DT = 120, 0.01


def fleet(n_units: int = UNITS, outputs: int = 2, seed: int = 0) -> StateSpace:
    """Systems of two states and one input that differ in poles and gains."""
    rng = np.random.default_rng(seed)
    A = np.zeros((n_units, 2, 2))
    A[:, 0, 0], A[:, 1, 1] = 0.9 + 0.01 * rng.normal(size=n_units), 0.6 + 0.03 * rng.normal(size=n_units)
    A[:, 1, 0] = 0.1 * (1 + 0.1 * rng.normal(size=n_units))
    B = np.stack([0.1 * (1 + 0.05 * rng.normal(size=n_units)), np.full(n_units, 0.02)], axis=1)[:, :, None]
    C = np.broadcast_to(np.eye(2)[:outputs], (n_units, outputs, 2))
    return StateSpace(A, B, C, np.zeros((n_units, outputs, 1)), DT)


@pytest.mark.parametrize(("form", "outputs"), [("inverse_input_multiplicative", 2), ("output_multiplicative", 1)])
def test_weights_of_a_fleet_cover_all_of_it(form, outputs):
    units, freqs, dense = fleet(outputs=outputs), np.geomspace(0.05, 49, 50), np.geomspace(1e-3, 49.9, 1500)
    found = quantify(units, form, freqs, max_order=2)
    assert found.weight.method is ProofMethod.LEVEL_SETS
    G, Gp = found.nominal_system.frequency_response(dense), units.frequency_response(dense)
    pairs = [(residual(form, G, Gp), found.weight)]
    pairs += [(completion(form, G, Gp)[1], found.remainder)] if found.remainder else []
    for E, weight in pairs:
        assert weight.magnitudes(dense).ratio(E).max() <= 1 + 1e-9
    E = residual(form, *(s.frequency_response(freqs) for s in (found.nominal_system, units)))
    assert found.cover.ratio(E).max() <= 1 + 1e-9


def test_the_spread_of_models_is_that_of_all_pairs():
    units = fleet(30, seed=4)
    z = np.exp(1j * np.pi * np.logspace(-6, 0, 50))
    G = np.linalg.solve(z[:, None, None] * np.eye(2) - units.A[:, None], units.B[:, None] + 0j)
    peaks = [np.linalg.norm(np.linalg.pinv(G) @ (g - G), ord=2, axis=(-2, -1)).max() for g in G]
    found = peak_residual(units.A, units.B, 50)
    assert found == pytest.approx(min(peaks), rel=1e-9)
    alike = units[np.zeros(5, int)]
    assert peak_residual(alike.A, alike.B, 50) == 0
