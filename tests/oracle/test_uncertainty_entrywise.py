"""Entrywise weights: true for the diagonal perturbation they come with, and for no other."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests.support.residuals import of_function, of_units

from kros.core.lti import StateSpace, gain
from kros.design.uncertain_set import usable_problem
from kros.uncertainty import Form, UncertainModel, quantify, residual
from kros.uncertainty.weights.certificate import Method
from kros.uncertainty.weights.cover import Structure
from kros.uncertainty.weights.fit import Target, fit_entries
from kros.uncertainty.weights.pencils import ResidualSystems
from kros.uncertainty.weights.weight import EntrywiseWeight

DT = 1e-3
GRID = np.geomspace(0.01, 500.0, 60)
LINEAR = np.linspace(0.0, 500.0, 5001)


def lags(gains: np.ndarray, corners_hz: np.ndarray) -> StateSpace:
    """Matrices of first-order lags, shape (unit, p, m): `gain (1 - a) / (z - a)` with a feedthrough of a tenth."""
    units, p, m = gains.shape
    A, B, C = np.zeros((units, p * m, p * m)), np.zeros((units, p * m, m)), np.zeros((units, p, p * m))
    for n, (i, j) in enumerate(np.ndindex(p, m)):
        pole = np.exp(-2 * np.pi * corners_hz[:, i, j] * DT)
        A[:, n, n], B[:, n, j], C[:, i, n] = pole, 1 - pole, gains[:, i, j]
    return StateSpace(A, B, C, 0.1 * gains, DT)


def scattered(seed: int, p: int, m: int, units: int = 3) -> StateSpace:
    rng = np.random.default_rng(seed)
    return lags(rng.normal(size=(units, p, m)), np.exp(rng.uniform(0, 4, size=(units, p, m))))


@pytest.mark.parametrize("shape", [(2, 2), (3, 2)])
def test_every_entry_is_bounded_and_the_dyads_rebuild_the_residual(shape: tuple[int, int]) -> None:
    p, m = shape
    units = scattered(1, p, m)
    residuals = units.frequency_response
    weight, cover = fit_entries(of_units(units), GRID, Target(DT, 2, 3.0))
    assert isinstance(weight, EntrywiseWeight)
    assert weight.structure is Structure.ENTRYWISE
    assert weight.method is Method.LEVEL_SETS
    E, W = residuals(LINEAR), weight.matrix().frequency_response(LINEAR)
    assert (np.abs(E) <= np.abs(W)).all()
    left, right = weight.left.frequency_response(LINEAR), weight.right.frequency_response(LINEAR)
    delta = (E / W).reshape(len(E), len(LINEAR), p * m)
    np.testing.assert_allclose((left * delta[:, :, None, :]) @ right, E, atol=1e-12)
    np.testing.assert_allclose(weight.magnitudes(LINEAR).right, np.abs(W).reshape(len(LINEAR), p * m), rtol=1e-9)
    np.testing.assert_allclose(cover.right, np.abs(residuals(GRID)).max(axis=0).reshape(len(GRID), p * m))
    assert weight.right.n_states == sum(weight.right_orders)


def test_known_magnitudes_are_found() -> None:
    """Entries of one unit that is the largest everywhere: its own magnitudes are the tightest bounds, and of first order."""
    gains = np.array([[1.0, -0.3], [0.02, 4.0]])
    corners = np.array([[1.0, 10.0], [100.0, 3.0]])
    units = lags(np.array([gains, 0.4 * gains]), np.array([corners, corners]))
    weight, _ = fit_entries(of_units(units), GRID, Target(DT, tolerance_db=0.05))
    assert weight.right_orders == (1, 1, 1, 1)
    expected = np.abs(units[0].frequency_response(GRID)).reshape(len(GRID), 4)
    np.testing.assert_allclose(20 * np.log10(weight.magnitudes(GRID).right / expected), 0, atol=0.05)


def test_a_full_perturbation_is_exceeded_as_it_should_be() -> None:
    """The static example of the covers: W = [[1, 1], [1, 1.5]] bounds all entries; its inverse is [[3, -2], [-2, 2]]."""
    E = np.array([[[1.0, 1.0], [1.0, -1.0]], [[0.5, 0.5], [0.5, 1.5]]])
    weight, _ = fit_entries(of_function(lambda f: np.repeat(E[:, None], len(f), axis=1)), GRID, Target(DT))
    expected = np.linalg.norm(np.array([[3.0, -2.0], [-2.0, 2.0]]) @ E[0], 2)
    assert isinstance(weight, EntrywiseWeight)
    assert weight.unstructured_excess == pytest.approx(expected, rel=1e-6)
    assert weight.unstructured_excess > 5
    assert weight.cover_max <= 1


def test_where_nothing_is_to_be_covered() -> None:
    E = np.array([[[1.0, 0.0], [0.0, 1.0]]])
    weight, _ = fit_entries(of_function(lambda f: np.repeat(E[:, None], len(f), axis=1)), GRID, Target(DT))
    np.testing.assert_allclose(weight.left.D @ weight.right.D, E[0], atol=1e-6)
    assert weight.cover_max <= 1


@pytest.mark.parametrize("form", ["additive", "inverse_input_multiplicative", "output_multiplicative"])
def test_realisations_of_entries(form: str) -> None:
    """Level sets look at the entry that is bounded, also where forms are transposed."""
    units = scattered(2, 2, 2)
    nominal = scattered(3, 2, 2)[0]
    E = residual(form, nominal.frequency_response(GRID), units.frequency_response(GRID))
    two, one = gain([[2.0]], DT), gain([[1.0]], DT)
    s = 1j * np.tan(np.pi * GRID[:-1] * DT)
    for i, j in np.ndindex(2, 2):
        pencil = ResidualSystems(Form(form), nominal, units, (i, j)).ratios(two, one)[1]
        found = [(pencil.C @ np.linalg.solve(x * pencil.F - pencil.A, pencil.B) + pencil.D)[0, 0] for x in s]
        np.testing.assert_allclose(np.abs(found), np.abs(E[1, :-1, i, j]) / 2, rtol=1e-6)


def test_models_keep_their_weights_and_synthesis_refuses_them(tmp_path: Path) -> None:
    units = lags(1 + 0.1 * np.random.default_rng(4).normal(size=(3, 2, 2)) + np.eye(2), np.full((3, 2, 2), 5.0))
    model = quantify(units, freqs_hz=GRID, structure="entrywise", max_order=2, tolerance_db=3.0)
    model.save(tmp_path)
    loaded = UncertainModel.load(tmp_path).weight
    assert isinstance(loaded, EntrywiseWeight)
    assert isinstance(model.weight, EntrywiseWeight)
    assert loaded.unstructured_excess == pytest.approx(model.weight.unstructured_excess)
    np.testing.assert_array_equal(
        loaded.matrix().frequency_response(GRID), model.weight.matrix().frequency_response(GRID)
    )
    problem, reason = usable_problem(SimpleNamespace(name="models"), model, np.zeros(1))  # type: ignore[arg-type]
    assert problem is None
    assert "entrywise" in reason
    assert "diagonal perturbation" in reason


def test_continuous_models() -> None:
    poles = np.array([-1.0, -1.3, -0.8])[:, None, None] * np.eye(2)
    coupled = np.array([[1.0, 0.4], [-0.2, 1.0]])
    units = StateSpace(
        poles, np.broadcast_to(coupled, (3, 2, 2)), np.broadcast_to(np.eye(2), (3, 2, 2)), np.zeros((3, 2, 2)), 0.0
    )
    model = quantify(
        units, "additive", np.geomspace(0.01, 10, 60), structure="entrywise", max_order=2, tolerance_db=3.0
    )
    freqs = np.geomspace(0.01, 10, 500)
    E = residual("additive", units[model.nominal].frequency_response(freqs), units.frequency_response(freqs))
    assert isinstance(model.weight, EntrywiseWeight)
    assert model.weight.right.dt == 0
    assert (np.abs(E) <= np.abs(model.weight.matrix().frequency_response(freqs)) * (1 + 1e-9)).all()
