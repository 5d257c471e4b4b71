"""Many units: quicker ways give what the ordinary ones give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kros.core.lti import StateSpace
from kros.identify.refine.metric import peak_residual
from kros.uncertainty import quantify, residual
from kros.uncertainty.forms import completion
from kros.uncertainty.settings import FIT
from kros.uncertainty.weights import fit, residuals
from kros.uncertainty.weights.proof import Method
from kros.uncertainty.weights.residuals import Residuals

UNITS, DT = 210, 0.01


def fleet(n_units: int = UNITS, outputs: int = 2, seed: int = 0) -> StateSpace:
    """Systems of two states and one input that differ in poles and gains."""
    rng = np.random.default_rng(seed)
    A = np.zeros((n_units, 2, 2))
    A[:, 0, 0], A[:, 1, 1] = 0.9 + 0.01 * rng.normal(size=n_units), 0.6 + 0.03 * rng.normal(size=n_units)
    A[:, 1, 0] = 0.1 * (1 + 0.1 * rng.normal(size=n_units))
    B = np.stack([0.1 * (1 + 0.05 * rng.normal(size=n_units)), np.full(n_units, 0.02)], axis=1)[:, :, None]
    C = np.broadcast_to(np.eye(2)[:outputs], (n_units, outputs, 2))
    return StateSpace(A, B, C, np.zeros((n_units, outputs, 1)), DT)


@pytest.mark.parametrize(
    ("form", "outputs"), [("inverse_input_multiplicative", 2), ("additive", 2), ("output_multiplicative", 1)]
)
def test_weights_of_a_fleet_cover_all_of_it_and_are_those_of_all_units_together(form, outputs, monkeypatch):
    units, freqs = fleet(outputs=outputs), np.geomspace(0.05, 49, 50)
    found = quantify(units, form, freqs, max_order=2)
    for module in (fit, residuals):
        monkeypatch.setattr(module, "FIT", replace(FIT, block=10**6))
    expected = quantify(units, form, freqs, max_order=2)
    assert found.nominal == expected.nominal
    np.testing.assert_allclose(found.bounds[found.form], expected.bounds[found.form], rtol=1e-9)
    np.testing.assert_allclose(found.misfit, expected.misfit, rtol=1e-9, atol=1e-12)
    assert found.weight.method is expected.weight.method is Method.LEVEL_SETS
    own, theirs = (w.magnitudes(freqs).cost_db() for w in (found.weight, expected.weight))
    assert (own - theirs).max() <= 0.5  # dB; diagonal fits of few units have other ends, here lower ones
    dense = np.geomspace(1e-3, 49.9, 1500)
    G, Gp = found.nominal_system.frequency_response(dense), units.frequency_response(dense)
    pairs = [(residual(form, G, Gp), found.weight)] + (
        [(completion(form, G, Gp)[1], found.remainder)] if found.remainder else []
    )
    assert (found.remainder is None) == (expected.remainder is None)
    for E, weight in pairs:
        assert weight.magnitudes(dense).ratio(E).max() <= 1 + 1e-9
    E = residual(form, *(s.frequency_response(freqs) for s in (found.nominal_system, units)))
    assert found.cover.ratio(E).max() <= 1 + 1e-9


@pytest.mark.parametrize("rounds", [3, 1])
def test_units_that_were_not_looked_at_join_the_fit_or_lift_the_weights(monkeypatch, rounds):
    units, freqs = fleet(), np.geomspace(0.05, 49, 60)
    monkeypatch.setattr(Residuals, "deciding", lambda self, freqs_hz: self.of(np.arange(3)))
    monkeypatch.setattr(fit, "FIT", replace(FIT, rounds=rounds))
    found = quantify(units, "additive", freqs, max_order=2)
    E = residual("additive", *(s.frequency_response(freqs) for s in (found.nominal_system, units)))
    assert found.weight.magnitudes(freqs).ratio(E).max() <= 1 + 1e-9
    assert found.cover_max <= 1
    assert found.cover.ratio(E).max() <= 1 + 1e-9


def test_a_fleet_of_units_that_are_all_the_same():
    one = fleet(1)
    same = StateSpace(*(np.repeat(M, UNITS, axis=0) for M in (one.A, one.B, one.C, one.D)), DT)
    assert quantify(same, "additive", np.geomspace(0.1, 49, 50), max_order=1).cover_max == 0


def test_the_spread_of_models_is_that_of_all_pairs():
    units = fleet(30, seed=4)
    z = np.exp(1j * np.pi * np.logspace(-6, 0, 50))
    G = np.linalg.solve(z[:, None, None] * np.eye(2) - units.A[:, None], units.B[:, None] + 0j)
    peaks = [np.linalg.norm(np.linalg.pinv(G) @ (g - G), ord=2, axis=(-2, -1)).max() for g in G]
    found = peak_residual(units.A, units.B, 50)
    assert found == pytest.approx(min(peaks), rel=1e-9)
    alike = units[np.zeros(5, int)]
    assert peak_residual(alike.A, alike.B, 50) == 0
