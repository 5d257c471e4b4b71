"""Full weights against a bound that no weight of any structure goes below: `mean log left + mean log right >= log |det E_k| / p`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import check_grad

from kros.core.lti import StateSpace, block_diagonal, gain
from kros.uncertainty import (
    FullWeight,
    Method,
    Perturbation,
    ResidualSystems,
    Structure,
    UncertainModel,
    fit_weight,
    quantify_systems,
    residual,
)
from kros.uncertainty.small_matrices import entries_first
from kros.uncertainty.weights.full import volume_db
from kros.uncertainty.weights.full_multipliers import _Search, best_frames, unit_triangular, with_floor
from kros.uncertainty.weights.pencils import ratio_systems

DT = 1e-3
GRID = np.geomspace(0.05, 500.0, 60)
LINEAR = np.linspace(0.0, 500.0, 4001)
QUICK: dict[str, Any] = {"max_order": 2, "density": 2}


def lag(gain_at_dc: float, corner_hz: float) -> StateSpace:
    """A lag with a feedthrough of a hundredth."""
    pole = np.exp(-2 * np.pi * corner_hz * DT)
    return StateSpace([[pole]], [[1 - pole]], [[0.99 * gain_at_dc]], [[0.01 * gain_at_dc]], DT)


def between(left: StateSpace, right: StateSpace, shares: list[tuple[float, float]]) -> tuple[ResidualSystems, StateSpace]:
    """Units `left diag(a d_1, b d_2) right` with known lags d, against a plant of zero; the first unit is the largest in both."""
    inner = [left @ block_diagonal([lag(a, 3.0), lag(0.1 * b, 40.0)]) @ right for a, b in [(1.0, 1.0), *shares]]
    units = StateSpace(*(np.stack([getattr(s, x) for s in inner]) for x in "ABCD"), DT)
    return ResidualSystems("additive", gain(np.zeros((2, 2)), DT), units), units


def ratio(weight: FullWeight, E: np.ndarray, freqs: np.ndarray) -> float:
    """Slow and independent: the systems inverted frequency by frequency."""
    left, right = weight.left.frequency_response(freqs), weight.right.frequency_response(freqs)
    return max(
        np.linalg.svd(np.linalg.inv(a) @ e @ np.linalg.inv(b))[1][0] for unit in E for a, e, b in zip(left, unit, right, strict=True)
    )


def of_no_structure_db(E: np.ndarray) -> float:
    """What the mean volume of any weights is at least: the determinant of `W_L^-1 E W_R^-1` is at most one."""
    return float((10 * np.log10(np.abs(np.linalg.det(E)).max(axis=0))).mean())


ROTATED = np.array([[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]])
SKEWED = np.array([[1.0, 0.0], [-0.7, 1.0]])
SHARES = [(0.9, -1.0), (-0.5, 0.2)]


def test_a_known_frame_is_found() -> None:
    """E_k = T diag(d_k) S: the optimum is known, W_L = T diag(max |d_k|) up to a factor on the right."""
    systems, units = between(gain(ROTATED, DT), gain(SKEWED, DT), SHARES)
    weight, _ = fit_weight(units.frequency_response, GRID, DT, structure="full", systems=systems, tolerance_db=0.5, **QUICK)
    assert isinstance(weight, FullWeight)
    assert weight.structure is Structure.FULL
    assert weight.perturbation is Perturbation.FULL
    assert weight.method is Method.LEVEL_SETS
    assert ratio(weight, units.frequency_response(LINEAR), LINEAR) <= 1
    optimum = of_no_structure_db(units.frequency_response(GRID))
    assert optimum <= volume_db(weight, GRID) <= optimum + 0.5
    diagonal, _ = fit_weight(units.frequency_response, GRID, DT, structure="diagonal", tolerance_db=0.5, **QUICK)
    assert weight.saved_db == pytest.approx(volume_db(diagonal, GRID) - volume_db(weight, GRID), abs=1e-3)
    assert weight.saved_db > 1


def test_a_direction_that_turns_is_followed() -> None:
    """E_k = [[1, 0], [u(z), 1]] T diag(d_k) T^T: no constant frame does it."""
    turn = lag(3.0, 1.0)
    turning = StateSpace(turn.A, turn.B @ [[1.0, 0.0]], [[0.0], [1.0]] @ turn.C, np.array([[1.0, 0.0], [turn.D[0, 0], 1.0]]), DT)
    systems, units = between(turning @ gain(ROTATED, DT), gain(ROTATED.T, DT), SHARES)
    E = units.frequency_response(GRID)
    lagged, constant, still = best_frames(E, GRID, DT)
    assert lagged.cost < constant.cost - 0.1
    assert constant.cost < still.cost - 0.5
    weight, _ = fit_weight(units.frequency_response, GRID, DT, structure="full", systems=systems, **QUICK)
    assert isinstance(weight, FullWeight)
    assert weight.saved_db > 5
    assert ratio(weight, units.frequency_response(LINEAR), LINEAR) <= 1
    assert of_no_structure_db(E) <= volume_db(weight, GRID) <= of_no_structure_db(E) + 1.5


def test_nothing_is_lost_where_nothing_is_gained() -> None:
    systems, units = between(gain(np.eye(2), DT), gain(np.eye(2), DT), SHARES)
    weight, _ = fit_weight(units.frequency_response, GRID, DT, structure="full", systems=systems, **QUICK)
    diagonal, _ = fit_weight(units.frequency_response, GRID, DT, structure="diagonal", systems=systems, **QUICK)
    assert isinstance(weight, FullWeight)
    assert volume_db(weight, GRID) <= volume_db(diagonal, GRID) + 1e-9  # dB: the same weight, its operations in another order
    assert weight.saved_db < 0.1


def test_residuals_of_one_direction_are_covered_too() -> None:
    """The optimum has no volume; weights stay regular systems."""
    units = StateSpace(*(np.stack([getattr(lag(*a), x) for a in ((1.0, 5.0), (-0.6, 30.0))]) for x in "ABCD"), DT)
    direction = np.array([[0.8], [0.6]]), np.array([[1.0, -2.0]])

    def residuals(freqs: np.ndarray) -> np.ndarray:
        return direction[0] @ units.frequency_response(freqs) @ direction[1]

    weight, _ = fit_weight(residuals, GRID, DT, structure="full", **QUICK)
    assert isinstance(weight, FullWeight)
    assert weight.cover_max <= 1
    assert weight.saved_db > 10
    assert ratio(weight, residuals(LINEAR[::10]), LINEAR[::10]) <= 1


@pytest.mark.parametrize("form", ["additive", "output_multiplicative", "inverse_input_multiplicative", "inverse_output_multiplicative"])
def test_realisations_between_weights_that_are_not_symmetric(form: str) -> None:
    """Forms on the output side are transposed for the level sets, and the weights with them."""
    rng = np.random.default_rng(5)
    A = 0.7 * np.linalg.qr(rng.normal(size=(3, 3)))[0] * (1 + 0.05 * rng.normal(size=(3, 3, 3)))
    units = StateSpace(A, rng.normal(size=(3, 3, 2)), rng.normal(size=(3, 2, 3)), rng.normal(size=(3, 2, 2)), DT)
    freqs = GRID[:-1:10]
    E = residual(form, units[0].frequency_response(freqs), units.frequency_response(freqs))
    left, right = gain(ROTATED @ np.diag([1.0, 5.0]), DT), gain(SKEWED, DT)
    pencil = ratio_systems(ResidualSystems(form, units[0], units), left, right)[2]
    found = [
        np.linalg.norm(pencil.C @ np.linalg.solve(1j * np.tan(np.pi * f * DT) * pencil.F - pencil.A, pencil.B) + pencil.D, 2) for f in freqs
    ]
    expected = np.linalg.norm(np.linalg.inv(left.D) @ E[2] @ np.linalg.inv(right.D), 2, axis=(-2, -1))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("shape", [(2, 2), (3, 2), (2, 3)])
def test_gradient(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(6)
    E = rng.normal(size=(3, 4, *shape)) + 1j * rng.normal(size=(3, 4, *shape))
    search = _Search(entries_first(with_floor(E)), 1j * np.array([1e-3, 0.1, 1.0, 5.0]), np.array([0.01, 1.0]), DT)
    y = search.start() + 0.2 * rng.normal(size=search.start().size)
    assert check_grad(lambda z: search.cost(z, 3)[0], lambda z: search.cost(z, 3)[1], y) < 1e-5


def test_frames_are_systems_of_determinant_one() -> None:
    rng = np.random.default_rng(7)
    E = rng.normal(size=(2, len(GRID), 3, 2)) + 1j * rng.normal(size=(2, len(GRID), 3, 2))
    for frames in best_frames(E, GRID, DT):
        for system in (frames.left, frames.right):
            assert bool(system.is_stable())
            np.testing.assert_allclose(np.abs(np.linalg.det(system.frequency_response(GRID))), 1, rtol=1e-7)


def test_triangular_factors_are_what_they_say() -> None:
    knots, c = np.array([0.01, 0.5]), np.array([[0.5, -1.0, 2.0], [0.0, 0.3, 0.1], [1.0, 0.2, -0.7]])
    system = unit_triangular(3, np.tril_indices(3, -1), c, knots, DT)
    w = 1j * np.tan(np.pi * LINEAR[1:-1] * DT)
    expected = np.repeat(np.eye(3, dtype=complex)[None], len(w), axis=0)
    for (i, j), values in zip(np.transpose(np.tril_indices(3, -1)), c, strict=True):
        expected[:, i, j] = values[0] + sum(v * t / (t + w) for v, t in zip(values[1:], knots, strict=True))
    np.testing.assert_allclose(system.frequency_response(LINEAR[1:-1]), expected, atol=1e-9)


@pytest.mark.parametrize("dt", [DT, 0.0])
def test_models_keep_their_weights_in_both_times(dt: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    poles = np.array([1.0, 1.3, 0.8, 1.1])[:, None, None] * np.diag([1.0, 3.0])
    T = ROTATED @ np.diag([1.0, 0.1])
    A = -poles if dt == 0 else np.eye(2) - 0.01 * poles
    B = T @ np.diag([1.0, 1.0]) @ SKEWED * (1 + 0.02 * rng.normal(size=(4, 1, 1)))
    units = StateSpace(A, B * (1.0 if dt == 0 else 0.01), np.broadcast_to(ROTATED.T, (4, 2, 2)), np.zeros((4, 2, 2)), dt)
    freqs = np.geomspace(0.01, 10, 60) if dt == 0 else GRID
    model = quantify_systems(units, "additive", freqs, structure="full", max_order=2, tolerance_db=3.0, density=2)
    E = residual("additive", units[model.nominal].frequency_response(freqs), units.frequency_response(freqs))
    assert isinstance(model.weight, FullWeight)
    assert model.weight.left.dt == dt
    assert ratio(model.weight, E, freqs) <= 1 + 1e-9
    model.save(tmp_path)
    loaded = UncertainModel.load(tmp_path).weight
    assert isinstance(loaded, FullWeight)
    assert loaded.saved_db == model.weight.saved_db
    np.testing.assert_array_equal(loaded.magnitudes(freqs).left, model.weight.magnitudes(freqs).left)
