"""The table of forms against a thousand random plants of each shape: exact where it says so, completed by the remainder elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from kros.uncertainty import Form, misfit, rebuild, residual
from kros.uncertainty.forms import completion

FORMS = list(Form)
COUNT = 1000
# Generic plants: a tall one has a full row space and a range that is its own, a wide one the other way round.
GENERIC = {
    "tall": {Form.ADDITIVE, Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE},
    "wide": {Form.ADDITIVE, Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE},
    "square": set(FORMS),
}
SHAPES = {"tall": (4, 2), "wide": (2, 4), "square": (3, 3)}


def complex_normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def regular(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Random matrices with singular values between one half and two, so that rounding is not what is measured."""
    U, _, V = np.linalg.svd(complex_normal(rng, *shape), full_matrices=False)
    return (U * rng.uniform(0.5, 2.0, size=(*shape[:-2], 1, U.shape[-1]))) @ V


def pairs(kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng, shape = np.random.default_rng(seed), SHAPES[kind]
    return regular(rng, COUNT, *shape), regular(rng, COUNT, *shape)


def apply(form: Form, G: np.ndarray, E: np.ndarray) -> np.ndarray:
    """The perturbed plant of one pair, word by word from the table."""
    eye = np.eye(E.shape[0])
    return {
        Form.ADDITIVE: lambda: G + E,
        Form.INPUT_MULTIPLICATIVE: lambda: G @ (eye + E),
        Form.OUTPUT_MULTIPLICATIVE: lambda: (eye + E) @ G,
        Form.INVERSE_ADDITIVE: lambda: G @ np.linalg.inv(np.eye(G.shape[1]) - E @ G),
        Form.INVERSE_INPUT_MULTIPLICATIVE: lambda: G @ np.linalg.inv(eye - E),
        Form.INVERSE_OUTPUT_MULTIPLICATIVE: lambda: np.linalg.inv(eye - E) @ G,
    }[form]()


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", SHAPES)
def test_thousand_random_plants(kind: str, form: Form) -> None:
    G, Gp = pairs(kind, 1)
    exact = np.full(COUNT, form in GENERIC[kind])
    E, rest, _ = completion(form, G, Gp)
    size = np.linalg.norm(Gp, 2, axis=(-2, -1))
    error = (
        np.linalg.norm(np.array([apply(form, g, e) for g, e in zip(G, E, strict=True)]) - Gp, 2, axis=(-2, -1)) / size
    )
    with_rest = np.array([apply(form, g, e) for g, e in zip(G, E, strict=True)]) + rest
    assert (error[exact] < 1e-9).all()
    assert (error[~exact] > 1e-9).all()  # the table is not only sufficient
    reach = 1e-9 * np.maximum(
        size, np.linalg.norm(rest, 2, axis=(-2, -1))
    )  # rounding of a remainder larger than the plant counts against it
    assert (np.linalg.norm(with_rest - Gp, 2, axis=(-2, -1)) <= reach).all()
    known = np.array([misfit(form, g[None], gp[None, None])[0, 0] for g, gp in zip(G[:50], Gp[:50], strict=True)])
    np.testing.assert_allclose(known, error[:50], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("side", ["range", "rows"])
@pytest.mark.parametrize("kind", ["tall", "wide"])
def test_the_conditions_of_the_table_are_met_one_by_one(form: Form, side: str, kind: str) -> None:
    """Plants that share a range (or a row space): forms need one of them, the inverse additive both."""
    rng, (p, m) = np.random.default_rng(2), SHAPES[kind]
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
