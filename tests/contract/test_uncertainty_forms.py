"""All six forms: residual and rebuilding undo each other where the table says so, and all fast paths agree with slow ones."""

from __future__ import annotations

import numpy as np
import pytest

from kros.core.errors import ConfigError, DimensionError
from kros.uncertainty import Form, choose_nominal, misfit, residual, sigma_max

SHAPES = [(2, 2), (3, 3), (1, 1), (4, 2), (2, 4), (3, 1), (1, 3), (5, 3)]
FORMS = list(Form)


def plants(seed: int, *shape: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def direct(form: Form, g: np.ndarray, gp: np.ndarray) -> np.ndarray:
    """The table of design section 7, word by word, for one pair of matrices."""
    pinv = np.linalg.pinv
    d = gp - g
    return {
        Form.ADDITIVE: lambda: d,
        Form.INPUT_MULTIPLICATIVE: lambda: pinv(g) @ d,
        Form.OUTPUT_MULTIPLICATIVE: lambda: d @ pinv(g),
        Form.INVERSE_ADDITIVE: lambda: pinv(gp) @ d @ pinv(g),
        Form.INVERSE_INPUT_MULTIPLICATIVE: lambda: pinv(gp) @ d,
        Form.INVERSE_OUTPUT_MULTIPLICATIVE: lambda: d @ pinv(gp),
    }[form]()


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape", SHAPES)
def test_residual_agrees_with_the_definition(form: Form, shape: tuple[int, int]) -> None:
    G, Gp = plants(1, 6, *shape), plants(2, 6, *shape)
    E = residual(form, G, Gp)
    np.testing.assert_allclose(E, [direct(form, a, b) for a, b in zip(G, Gp, strict=True)], rtol=1e-10, atol=1e-10)


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
