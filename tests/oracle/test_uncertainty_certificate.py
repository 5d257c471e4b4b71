"""Bounds between grid points and bounds on what a fit can reach, against cases whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from forms import plant_of, residual_of
from residuals import of_systems

from kros.core.lti import StateSpace, gain
from kros.core.norms import hinf_norm
from kros.uncertainty import Form, fit_magnitude, residual
from kros.uncertainty.weights.cover import Cover
from kros.uncertainty.weights.proof import ProofMethod, certify

DT = 1e-3
GRID = np.geomspace(0.1, 500.0, 60)


def population(seed: int, units: int, p: int, m: int, n: int = 3) -> tuple[StateSpace, StateSpace]:
    rng = np.random.default_rng(seed)
    A = 0.7 * np.linalg.qr(rng.normal(size=(n, n)))[0] * (1 + 0.05 * rng.normal(size=(units + 1, n, n)))
    B, C = rng.normal(size=(n, m)), rng.normal(size=(p, n))
    D = rng.normal(size=(p, m)) * (1 + 0.1 * rng.normal(size=(units + 1, p, m)))
    every = StateSpace(A, np.broadcast_to(B, (units + 1, n, m)), np.broadcast_to(C, (units + 1, p, n)), D, DT)
    return every[0], every[1:]


@pytest.mark.parametrize("shape", [(2, 2), (3, 2), (2, 3)])
@pytest.mark.parametrize("form", list(Form))
def test_realisations_have_the_responses_of_the_residuals(form: Form, shape: tuple[int, int]) -> None:
    nominal, units = population(3, 2, *shape)
    E = residual(form, nominal.frequency_response(GRID), units.frequency_response(GRID))
    left, right = (gain(np.diag(np.arange(1.0, n + 1)), DT) for n in E.shape[2:])
    expected = Cover(np.tile(np.diag(left.D), (60, 1)), np.tile(np.diag(right.D), (60, 1))).ratio(E)
    for unit, pencil in enumerate(of_systems(form, nominal, units).ratios(left, right)):
        s = 1j * np.tan(np.pi * GRID[:-1] * DT)
        found = [np.linalg.norm(pencil.C @ np.linalg.solve(x * pencil.F - pencil.A, pencil.B) + pencil.D, 2) for x in s]
        np.testing.assert_allclose(found, expected[unit, :-1], rtol=1e-7)


@pytest.mark.parametrize(
    "form",
    ["input_multiplicative", "inverse_input_multiplicative", "output_multiplicative", "inverse_output_multiplicative"],
)
@pytest.mark.parametrize("states", [1, 2, 3])
def test_realisations_of_remainders_are_what_the_form_leaves(form: str, states: int) -> None:
    """By pseudo-inverses at every frequency."""
    nominal, units = population(4, 2, *((2, 3) if "output" in form else (3, 2)), states)
    G, every = nominal.frequency_response(GRID), units.frequency_response(GRID)
    left_over = every - plant_of(form, G, residual_of(form, G, every))
    systems = of_systems(form, nominal, units, remainder=True)
    pencils = systems.ratios(gain(np.eye(nominal.n_outputs), DT), gain(np.eye(nominal.n_inputs), DT))
    assert len(pencils) == 2
    for pencil, expected in zip(pencils, left_over, strict=True):
        s = 1j * np.tan(np.pi * GRID[:-1] * DT)
        found = [np.linalg.norm(pencil.C @ np.linalg.solve(x * pencil.F - pencil.A, pencil.B) + pencil.D, 2) for x in s]
        np.testing.assert_allclose(found, np.linalg.norm(expected[:-1], 2, axis=(-2, -1)), rtol=1e-6, atol=1e-9)


def test_a_peak_between_grid_points_is_found_and_is_the_norm() -> None:
    """A resonance a millionth wide on a grid of 60 points: the additive peak is the H-infinity norm of the difference."""
    radius, angle = 1 - 1e-6, 2 * np.pi * 37.77 * DT
    A = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    unit = StateSpace(A[None], np.array([[[1e-5], [0.0]]]), np.array([[[1.0, 0.0]]]), np.array([[[0.1]]]), DT)
    nominal = gain([[0.0]], DT)
    one = gain([[1.0]], DT)

    def ratio(freqs: np.ndarray) -> np.ndarray:
        return np.abs(unit.frequency_response(freqs)[:, :, 0, 0])

    proof = certify(ratio, GRID, ratio(GRID), of_systems("additive", nominal, unit).ratios(one, one), DT)
    assert proof.method is ProofMethod.LEVEL_SETS
    assert proof.peak == pytest.approx(hinf_norm(unit[0]), rel=2e-5)
    assert proof.freq_hz == pytest.approx(37.77, rel=1e-4)
    assert ratio(GRID).max() < proof.peak / 2
    assert certify(ratio, GRID, ratio(GRID), [], DT).method is ProofMethod.GRID


def test_a_first_order_is_as_good_as_an_exhaustive_search_over_pole_and_zero() -> None:
    """A step of two levels."""
    freqs = np.geomspace(0.05, 499.0, 80)
    data = np.where(freqs < 5.0, 3.0, 1.0)
    fit = fit_magnitude(freqs, data, DT, max_order=1, tolerance_db=0.0)
    best = np.inf
    for pole in 1 - np.geomspace(1e-5, 1.0, 120):
        z = np.exp(2j * np.pi * freqs * DT)
        for zero in 1 - np.geomspace(1e-5, 1.0, 120):
            level = 20 * np.log10(np.abs((z - zero) / (z - pole)) / data)
            best = min(best, float(np.ptp(level)))
    assert fit.overbound_db <= best + 1e-6
    assert fit.overbound_db > best - 0.1
