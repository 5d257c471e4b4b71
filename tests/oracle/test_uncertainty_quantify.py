"""Weights of whole populations: sound on dense grids, checked by the definition of the forms."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from drives import DT, drives
from forms import residual_of

from kros.core import StateSpace
from kros.core.errors import ConfigError, DataError, DimensionError
from kros.uncertainty import Form, UncertainModel, quantify


def random_population(n_units: int, seed: int) -> StateSpace:
    """Perturbations of one random stable 4 x 2 system."""
    rng = np.random.default_rng(seed)
    base = rng.normal(size=(4, 4))
    base *= 0.95 / np.abs(np.linalg.eigvals(base)).max()
    A = base * (1 + 0.02 * rng.normal(size=(n_units, 4, 4)))
    A *= np.minimum(1, 0.97 / np.abs(np.linalg.eigvals(A)).max(axis=1))[:, None, None]
    B = rng.normal(size=(4, 2)) * (1 + 0.05 * rng.normal(size=(n_units, 4, 2)))
    return StateSpace(A, B, np.broadcast_to(np.eye(4), A.shape), np.zeros(B.shape), DT)


def largest_ratio(model: UncertainModel, units: StateSpace, freqs: np.ndarray) -> float:
    """Largest `sigma_max(W_L^-1 E W_R^-1)` from the definition of the form."""
    into = model.input_scale / model.output_scale[:, None]
    left, right, G = (
        s.frequency_response(freqs) for s in (model.weight.left, model.weight.right, model.nominal_system)
    )
    E = residual_of(model.form, G * into, units.frequency_response(freqs) * into)
    return float(np.linalg.norm(np.linalg.solve(left, E) @ np.linalg.inv(right), 2, axis=(-2, -1)).max())


@pytest.mark.parametrize("form", ["inverse_input_multiplicative", "additive"])
def test_weights_of_drives_are_sound_and_tight(form: str) -> None:
    units = drives(6, 1)
    model = quantify(units, form, np.geomspace(1e-1, 500.0, 80), output_scale=[1, 3, 1], input_scale=[1, 3])
    off_grid = np.random.default_rng(0).uniform(np.log(1e-1), np.log(500.0), 50)
    assert largest_ratio(model, units, np.concatenate([np.exp(off_grid), [1e-6, 500.0]])) <= 1 + 1e-6
    assert model.cover_max <= 1
    assert model.overbound_db_max <= 3
    assert max(*model.weight.left_orders, *model.weight.right_orders) <= 4
    for system in (model.weight.left, model.weight.right):
        assert system.is_stable()
        assert StateSpace(
            system.A - system.B @ np.linalg.solve(system.D, system.C), system.B, system.C, system.D, DT
        ).is_stable()


@pytest.mark.parametrize("form", list(Form))
def test_weights_of_random_tall_systems_are_sound(form: Form) -> None:
    units = random_population(4, 2)
    model = quantify(units, form, np.geomspace(1.0, 500.0, 60), tolerance_db=3.0)
    assert largest_ratio(model, units, np.linspace(1.0, 500.0, 41)) <= 1 + 1e-6
    assert model.cover_max <= 1
    exact = form in (Form.ADDITIVE, Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE)
    assert (model.remainder is None) == (model.misfit_max < 1e-12) == exact


def test_scalar_first_order_population_has_the_residual_of_the_textbook() -> None:
    """Lags `(1 - a) / (z - a)`: inverse input residual `1 - G / Gp` is exact, zero at DC, and the gain ratio at Nyquist is known."""
    poles = np.array([0.88, 0.9, 0.92])[:, None, None]
    units = StateSpace(poles, 1 - poles, np.ones((3, 1, 1)), np.zeros((3, 1, 1)), DT)
    model = quantify(units, freqs_hz=np.geomspace(1e-3, 500.0, 300))
    assert model.nominal == 1
    at_top = max(abs(1 - (0.1 / 1.9) / ((1 - a) / (1 + a))) for a in (0.88, 0.92))
    np.testing.assert_allclose(model.bounds[model.form][-1], at_top, rtol=1e-10)
    np.testing.assert_allclose(model.cover.left[-1, 0] * model.cover.right[-1, 0], at_top, rtol=1e-9)
    assert model.misfit_max < 1e-12
    assert model.remainder is None


def test_weights_are_the_same_in_other_units_of_measure_and_in_another_order() -> None:
    """Their optimum is unique: nothing but rounding moves it."""
    units, freqs = drives(5, 16), np.geomspace(1.0, 500.0, 24)
    out, into = np.array([1e3, 1e-4, 10.0]), np.array([1e-2, 1e4])
    plain, shuffled = (
        quantify(some, "input_multiplicative", freqs, max_order=2) for some in (units, units[[3, 1, 4, 0, 2]])
    )
    other = StateSpace(units.A, units.B / into, units.C * out[:, None], units.D, DT)
    scaled = quantify(other, "input_multiplicative", freqs, output_scale=out, input_scale=into, max_order=2)
    expected = plain.weight.magnitudes(freqs)
    for same in (scaled.weight, shuffled.weight):
        assert same.left_orders == plain.weight.left_orders
        found = same.magnitudes(freqs)
        product, known = (cover.left[:, :, None] * cover.right[:, None] for cover in (found, expected))
        np.testing.assert_allclose(product, known, rtol=1e-6)


@pytest.mark.parametrize(("form", "count"), [("inverse_input_multiplicative", 3), ("additive", 40)])
def test_identical_units_have_no_uncertainty(form: str, count: int) -> None:
    one = drives(1, 4)
    units = StateSpace(*(np.repeat(getattr(one, x), count, axis=0) for x in "ABCD"), DT)
    model = quantify(units, form, np.geomspace(1.0, 500.0, 20))
    assert model.cover_max == 0
    assert model.peak_db[model.form] == -np.inf
    assert not model.weight.left.D.any()


def test_nominal_may_be_named_and_a_set_is_saved(tmp_path: Path) -> None:
    units, freqs = drives(4, 5), np.geomspace(1.0, 500.0, 30)
    ids = ("a", "b", "c", "d")
    found = quantify(units, freqs_hz=freqs, unit_ids=ids, nominal="c", max_order=1)
    assert (found.nominal, found.nominal_id) == (2, "c")
    assert largest_ratio(found, units, np.array([1.3, 40.0, 333.0])) <= 1 + 1e-6
    found.save(tmp_path)
    loaded = UncertainModel.load(tmp_path)
    assert loaded.peak_db == found.peak_db
    assert loaded.weight.left_orders == found.weight.left_orders
    assert loaded.nominals == found.nominals
    np.testing.assert_array_equal(loaded.weight.left.A, found.weight.left.A)
    np.testing.assert_array_equal(loaded.misfit, found.misfit)
    with pytest.raises(ConfigError, match="'z'"):
        quantify(units, freqs_hz=freqs, unit_ids=ids, nominal="z")
    with pytest.raises(ConfigError, match="range"):
        quantify(units, freqs_hz=freqs, nominal=9)


def test_bad_input_is_refused() -> None:
    units = drives(3, 6)
    with pytest.raises(DataError, match="two units"):
        quantify(units[[0]])
    with pytest.raises(DimensionError, match="unit axis"):
        quantify(units[0])
    with pytest.raises(ConfigError, match="Nyquist"):
        quantify(units, freqs_hz=[1.0, 600.0])
    with pytest.raises(ConfigError, match="unknown"):
        quantify(units, "nonsense")
    with pytest.raises(DimensionError, match="output_scale"):
        quantify(units, output_scale=[1, 2])
    with pytest.raises(DimensionError, match="differ"):
        quantify([units[0], StateSpace(units.A[1], units.B[1], np.eye(3), np.zeros((3, 2)), 2 * DT)])
    unstable = StateSpace(np.stack([units.A[0], 1.2 * np.eye(3)]), units.B[:2], units.C[:2], units.D[:2], DT)
    with pytest.raises(DataError, match="unstable"):
        quantify(unstable, unit_ids=("a", "b"))
    broken = StateSpace(units.A * np.array([1, np.nan, 1])[:, None, None], units.B, units.C, units.D, DT)
    with pytest.raises(DataError, match="unit 1 has NaN"):
        quantify(broken)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"colour": "red"}, "colour: unknown key"),
        ({"max_order": -1}, "max_order: .*greater than or equal to 0, found -1"),
        ({"tolerance_db": -1.0}, "tolerance_db: .*greater than or equal to 0, found -1.0"),
        ({"nominal": 0.5}, "nominal.int: .* found 0.5"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    units = [StateSpace([[p]], [[1.0]], [[1.0]], [[0.0]], 0.01) for p in (0.9, 0.91)]
    with pytest.raises(ConfigError, match=message):
        quantify(units, **options)


def test_foreign_systems_are_read():
    units = [SimpleNamespace(A=[[p]], B=[[1.0]], C=[[1.0]], D=[[0.0]], dt=0.01) for p in (0.9, 0.91)]
    assert quantify(units, "additive").cover_max <= 1
    with pytest.raises(DimensionError, match="found int"):
        quantify(3)
