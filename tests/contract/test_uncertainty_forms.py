"""All six forms: residual and rebuilding undo each other where the table says so, a remainder completes them elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from forms import plant_of, residual_of

from kros.core.errors import ConfigError, DimensionError
from kros.uncertainty import Form, choose_nominal, misfit, rebuild, residual, sigma_max
from kros.uncertainty.forms import completion

SHAPES = [(2, 2), (3, 3), (1, 1), (4, 2), (2, 4), (3, 1), (1, 3), (5, 3)]
FORMS = list(Form)


def plants(seed: int, *shape: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape", SHAPES)
def test_residual_agrees_with_the_definition(form: Form, shape: tuple[int, int]) -> None:
    G, Gp = plants(1, 6, *shape), plants(2, 6, *shape)
    E = residual(form, G, Gp)
    np.testing.assert_allclose(E, residual_of(form, G, Gp), rtol=1e-10, atol=1e-10)


def test_a_singular_inverse_form_is_reported_as_unknown() -> None:
    G = np.eye(2)[None] + 0j
    Gp = np.diag([1.0, 1e-14])[None, None] + 0j  # E = diag(0, 1 - 1e14): far from one, regular
    singular = np.diag([1.0, 1e14])[None, None] + 0j  # E = diag(0, 1 - 1e-14)
    assert np.isfinite(misfit("input_multiplicative", G, singular)).all()
    assert np.isnan(misfit("inverse_input_multiplicative", G, singular)).all()
    assert np.isnan(misfit("inverse_input_multiplicative", G, Gp)).all()  # condition 1e14 as well


def test_paper_variants_hold_the_identity_on_the_complement_of_a_tall_range() -> None:
    G, Gp = plants(12, 5, 4, 2), plants(13, 5, 4, 2)
    for form in (Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE):
        assert (sigma_max(residual(form, G, Gp, paper=True)) >= 1 - 1e-12).all()
        near = residual(form, G, G + 1e-6 * Gp, paper=True)
        assert (sigma_max(near) >= 1 - 1e-12).all()
        assert (sigma_max(residual(form, G, G + 1e-6 * Gp)) < 1e-4).all()
    for form in (Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE):
        np.testing.assert_allclose(residual(form, G, Gp, paper=True), residual(form, G, Gp), atol=1e-10)
    pinv = np.linalg.pinv(G[0])
    np.testing.assert_allclose(
        residual("output_multiplicative", G[0], Gp[0], paper=True), Gp[0] @ pinv - np.eye(4), atol=1e-12
    )


def test_unknown_forms_and_shapes_are_refused() -> None:
    with pytest.raises(ConfigError, match="inverse_input_multiplicative"):
        residual("multiplicative", np.eye(2), np.eye(2))
    with pytest.raises(DimensionError, match=r"\(3, 3\)"):
        residual("additive", np.eye(2), np.eye(3))
    with pytest.raises(DimensionError, match="unit, frequency"):
        choose_nominal(np.eye(2), "additive")


COUNT = 1000
# Generic plants: a tall one has a full row space and a range that is its own, a wide one the other way round.
GENERIC = {
    "tall": {Form.ADDITIVE, Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE},
    "wide": {Form.ADDITIVE, Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE},
    "square": set(FORMS),
}
KINDS = {"tall": (4, 2), "wide": (2, 4), "square": (3, 3)}


def regular(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Random matrices with singular values between one half and two, so that rounding is not what is measured."""
    drawn = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    U, _, V = np.linalg.svd(drawn, full_matrices=False)
    return (U * rng.uniform(0.5, 2.0, size=(*shape[:-2], 1, U.shape[-1]))) @ V


def pairs(kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng, shape = np.random.default_rng(seed), KINDS[kind]
    return regular(rng, COUNT, *shape), regular(rng, COUNT, *shape)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", KINDS)
def test_thousand_random_plants(kind: str, form: Form) -> None:
    G, Gp = pairs(kind, 1)
    exact = np.full(COUNT, form in GENERIC[kind])
    E, rest, _ = completion(form, G, Gp)
    size = np.linalg.norm(Gp, 2, axis=(-2, -1))
    rebuilt = plant_of(form, G, E)
    error = np.linalg.norm(rebuilt - Gp, 2, axis=(-2, -1)) / size
    assert (error[exact] < 1e-9).all()
    assert (error[~exact] > 1e-9).all()  # the table is not only sufficient
    # rounding of a remainder larger than the plant counts against it
    reach = 1e-9 * np.maximum(size, np.linalg.norm(rest, 2, axis=(-2, -1)))
    assert (np.linalg.norm(rebuilt + rest - Gp, 2, axis=(-2, -1)) <= reach).all()
    known = np.array([misfit(form, g[None], gp[None, None])[0, 0] for g, gp in zip(G[:50], Gp[:50], strict=True)])
    np.testing.assert_allclose(known, error[:50], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("side", ["range", "rows"])
@pytest.mark.parametrize("kind", ["tall", "wide"])
def test_the_conditions_of_the_table_are_met_one_by_one(form: Form, side: str, kind: str) -> None:
    """Plants that share a range (or a row space): forms need one of them, the inverse additive both."""
    rng, (p, m) = np.random.default_rng(2), KINDS[kind]
    r = min(p, m)
    if side == "range":
        common = regular(rng, p, r)
        G, Gp = (common @ regular(rng, COUNT, r, m) for _ in range(2))
    else:
        common = regular(rng, r, m)
        G, Gp = (regular(rng, COUNT, p, r) @ common for _ in range(2))
    shares_range, shares_rows = side == "range" or kind == "wide", side == "rows" or kind == "tall"
    expected = {
        Form.ADDITIVE: True,
        Form.INPUT_MULTIPLICATIVE: shares_range,
        Form.OUTPUT_MULTIPLICATIVE: shares_rows,
        Form.INVERSE_ADDITIVE: shares_range and shares_rows,
        Form.INVERSE_INPUT_MULTIPLICATIVE: shares_range,
        Form.INVERSE_OUTPUT_MULTIPLICATIVE: shares_rows,
    }[form]
    rebuilt = rebuild(form, G, residual(form, G, Gp))
    exact = np.linalg.norm(rebuilt - Gp, axis=(-2, -1)) < 1e-9 * np.linalg.norm(Gp, axis=(-2, -1))
    assert (exact == expected).all()


def test_what_a_singular_inverse_cannot_reach_is_added_whole() -> None:
    G, Gp = np.eye(2)[None] + 0j, np.diag([1.0, 1e14])[None] + 0j
    E, rest, _ = completion("inverse_input_multiplicative", G, Gp)
    assert not E.any()
    np.testing.assert_array_equal(rest, Gp - G)
