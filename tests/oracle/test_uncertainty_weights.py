"""Weights of lightly damped units, of responses alone and of remainders: bounds and statements checked with formulas of this file."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from forms import plant_of, residual_of
from residuals import of_function

from kros.core import DataError, StateSpace
from kros.uncertainty import quantify
from kros.uncertainty.weights.cover import NEPER_DB
from kros.uncertainty.weights.fit import fit_weight

Array = np.ndarray[Any, Any]


def mode(radius: float, angle: float, gain: Array, through: Array, dt: float = 1.0) -> StateSpace:
    """A pair of poles between inputs (columns of through) and outputs (rows)."""
    A = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    B = np.vstack([np.ones(through.shape[1]), np.arange(through.shape[1])])
    return StateSpace(A, B, (1 - radius) * gain, through, dt)


def single(radius: float, angle: float, gain: float = 1.0) -> StateSpace:
    return mode(radius, angle, np.array([[gain, 0.3]]), np.array([[0.2]]))


def response(system: StateSpace, freqs: Array) -> Array:
    z = np.exp(2j * np.pi * freqs * system.dt) if system.dt else 2j * np.pi * freqs
    return system.C @ np.linalg.solve(z[:, None, None] * np.eye(system.n_states) - system.A, system.B + 0j) + system.D


def around(systems: list[StateSpace]) -> Array:
    """Frequencies within ten half-widths of every pole, and 2000 others up to Nyquist."""
    poles = np.concatenate([np.log(s.poles().astype(complex)) for s in systems if s.n_states])
    steps = np.linspace(-10, 10, 81)
    found = np.abs(poles.imag)[:, None] + np.abs(poles.real)[:, None] * steps
    freqs = np.concatenate([np.geomspace(1e-5, 0.5, 2000), found.ravel() / (2 * np.pi)])
    return np.unique(freqs[(freqs > 0) & (freqs <= 0.5)])


def largest(weight: Any, E: Array, freqs: Array) -> Array:
    """Largest sigma_max(W_L^-1 E_k W_R^-1) at every frequency."""
    left, right = response(weight.left, freqs), response(weight.right, freqs)
    return np.linalg.norm(np.linalg.solve(left, E) @ np.linalg.inv(right), 2, axis=(-2, -1)).max(axis=0)


LIGHT = [single(0.999, 0.3), single(0.999, 0.309, 1.1), single(0.999, 0.288, 0.9)]
GRID = np.geomspace(1e-4, 0.4999, 30)


def test_peaks_between_the_points_of_a_grid_are_covered_and_not_at_the_price_of_all_others() -> None:
    found = quantify(LIGHT, "additive", GRID, max_order=3)
    freqs = around([*LIGHT, found.weight.left])
    G = response(found.nominal_system, freqs)
    E = np.array([response(u, freqs) - G for u in LIGHT])
    assert largest(found.weight, E, freqs).max() <= 1 + 1e-9
    given = np.array([response(u, GRID) - response(found.nominal_system, GRID) for u in LIGHT])
    loose = -20 * np.log10(largest(found.weight, given, GRID))
    assert loose.max() == pytest.approx(found.overbound_db_max, abs=1e-6)


@pytest.mark.parametrize("points", [20, 60])
def test_modes_that_only_the_dense_check_resolves_are_fitted(points: int) -> None:
    """Entries of order four are within the tolerance of three modes; from frequencies that miss them they were not."""
    units = [single(0.98, angle, gain) for angle, gain in ((0.3, 1.0), (0.303, 1.1), (0.297, 0.9))]
    found = quantify(units, "additive", np.geomspace(1e-4, 0.4999, points), max_order=4, tolerance_db=1.0)
    assert found.overbound_db_max <= 1


def resonances(freqs: Array) -> Array:
    s = 2j * np.pi * freqs
    rows = []
    for shift, size in ((1.0, 1.0), (1.02, 1.1), (0.97, 0.9)):
        natural = 2 * np.pi * 0.03 * shift
        rows.append(size * natural**2 / (s**2 + 2 * 0.01 * natural * s + natural**2))
    return np.array(rows)[:, :, None, None]


def test_weights_of_responses_touch_at_a_given_frequency_and_tell_how_loose_they_are() -> None:
    freqs = np.geomspace(1e-3, 0.4999, 40)
    given = resonances(freqs)
    found = quantify(given, "additive", freqs, sample_period_s=1.0, max_order=2)
    E = given - found.nominal_response
    allowed = np.abs(response(found.weight.left, freqs) @ response(found.weight.right, freqs))[:, 0, 0]
    ratio = np.abs(E).max(axis=0)[:, 0, 0] / allowed
    assert 0.5 <= ratio.max() <= 1 + 1e-9
    loose = -20 * np.log10(ratio.min())
    assert found.overbound_db_max == pytest.approx(loose, abs=1e-6)


def test_responses_that_do_not_resolve_a_peak_are_told_so(caplog: pytest.LogCaptureFixture) -> None:
    coarse, fine = (
        np.geomspace(1e-3, 0.4, 60),
        np.unique(np.concatenate([np.geomspace(1e-3, 0.4, 60), np.linspace(0.028, 0.032, 81)])),
    )
    found = quantify(resonances(coarse), "additive", coarse, sample_period_s=1.0, max_order=1)
    (peak,) = re.findall(r"do not resolve 1 peaks of the residuals, at ([0-9.]+) Hz", found.certificate)
    assert abs(float(peak) - 0.03) < 0.003
    assert "more densely" in caplog.text
    caplog.clear()
    resolved = quantify(resonances(fine), "additive", fine, sample_period_s=1.0, max_order=1)
    assert "resolve" not in resolved.certificate
    assert not caplog.records


def tall(radius: float, angle: float, size: float) -> StateSpace:
    return mode(radius, angle, size * np.array([[1.0, 0.2], [-0.4, 0.9]]), np.array([[0.5], [0.3 * size]]))


@pytest.mark.parametrize("form", ["input_multiplicative", "inverse_input_multiplicative", "inverse_additive"])
@pytest.mark.parametrize("wide", [False, True])
def test_remainders_are_covered_between_the_points_of_a_grid(form: str, wide: bool) -> None:
    units = [tall(0.9995, 0.7, 1.0), tall(0.9993, 0.705, 1.2), tall(0.9996, 0.694, 0.8)]
    if wide:
        form = form.replace("input", "output")
        units = [StateSpace(u.A.T, u.C.T, u.B.T, u.D.T, u.dt) for u in units]
    found = quantify(units, form, np.geomspace(1e-3, 0.49, 16), max_order=1)
    weight = found.remainder
    assert weight is not None
    assert weight.method.value == "level sets"
    freqs = around([*units, weight.left, weight.right])
    G = response(found.nominal_system, freqs)
    parts = []
    for unit in units:
        P = response(unit, freqs)
        parts.append(P - plant_of(form, G, residual_of(form, G, P)))
    assert largest(weight, np.array(parts), freqs).max() <= 1 + 1e-8


def test_single_frequencies_get_weights() -> None:
    pair = [tall(0.9, 0.5, 1.0), tall(0.8, 0.6, 1.1)]
    for freqs in ([0.1], [0.0, 0.5], [0.5]):
        assert quantify(pair, "additive", freqs, max_order=2).cover_max <= 1


def test_units_that_are_alike_only_at_the_frequencies_given_are_refused() -> None:
    """`(z - 1) / (z - p)` is zero at DC, whatever p."""
    units = [StateSpace([[p]], [[1.0]], [[p - 1]], [[1.0]], 1.0) for p in (0.5, 0.6, 0.75)]
    with pytest.raises(DataError, match="differ elsewhere"):
        quantify(units, "additive", [0.0])


def test_diagonal_weights_say_how_far_they_are_from_the_optimal_cover() -> None:
    units = [tall(0.9, 0.5, 1.0), tall(0.8, 0.6, 1.1), tall(0.85, 0.4, 0.8)]

    def residuals(freqs: np.ndarray) -> np.ndarray:
        return np.array([response(u, freqs) - response(units[0], freqs) for u in units])

    weight, best = fit_weight(of_function(residuals), GRID, 1.0, 1, 0.1)
    assert weight.overbound_db_max == pytest.approx(
        (weight.magnitudes(GRID).cost() * NEPER_DB - best.cost() * NEPER_DB).max(), abs=1e-6
    )
