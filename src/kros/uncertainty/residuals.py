"""Residuals of a population: for every candidate nominal the largest residual over the other units, and the misfit of a chosen one.

All ordered pairs are visited once, in unordered pairs, and never stored. What one pair shares:

    D = G_k - G_j,   X_k = G_k^+ D,   X_j = G_j^+ D          (one difference, two products)
    E_ii(j, k) = X_k,   E_i(k, j) = -X_k;   E_ii(k, j) = -X_j,   E_i(j, k) = X_j
    sigma(E_o(k, j)) = sigma(E_io(j, k)) = sigma(D L_k),   sigma(E_ia(j, k)) = sigma(X_k L_j)

with `G^+ = L Q^H`, L small and triangular (`small.lower_factor`). Wide plants are transposed and the forms swapped; as
`E_ia(G^T, Gp^T) = -E_ia(Gp, G)^T`, the inverse additive form then has nominal and perturbed plant exchanged.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from .forms import MAX_CONDITION, Form, as_form, inverted_matrix, rebuild, residual
from .small_matrices import condition_number, entries_first, lower_factor, multiply, pseudo_inverse_first, sigma_max_first

Array = npt.NDArray[Any]

_CHUNK = 16000  # complex numbers in a vector; measured: 4000 and less cost a third more, larger ones gain nothing


def sigma_max(matrices: npt.ArrayLike) -> Array:
    """Return the largest singular value, shape (...), of matrices of shape (..., p, m)."""
    return sigma_max_first(entries_first(np.asarray(matrices)))


def bounds(form: Form | str, responses: Array, *, paper: bool = False, nominals: Sequence[int] | None = None) -> Array:
    """Return the largest residual over the other units, for every candidate nominal.

    Parameters
    ----------
    form : Form or str
    responses : ndarray, shape (unit, frequency, p, m), complex
        In scaled coordinates.
    paper : bool
        The published pipeline's variants (slower: nothing is shared).
    nominals : sequence of int, optional
        Candidates; all units by default.

    Returns
    -------
    ndarray, shape (nominal, frequency)
    """
    form = as_form(form)
    responses = check_responses(responses)
    if paper or nominals is not None:
        return _direct_bounds(form, responses, paper, range(len(responses)) if nominals is None else nominals)
    return all_bounds(responses, (form,))[form]


def all_bounds(responses: Array, forms: Iterable[Form | str] = tuple(Form)) -> dict[Form, Array]:
    """Return `bounds` for several forms in one pass over the pairs of units.

    Parameters
    ----------
    responses : ndarray, shape (unit, frequency, p, m), complex
    forms : iterable of Form or str

    Returns
    -------
    dict of Form to ndarray, shape (nominal, frequency)
    """
    wanted = [as_form(f) for f in forms]
    G = check_responses(responses)
    wide = G.shape[-2] < G.shape[-1]
    if wide:
        G, wanted = np.swapaxes(G, -1, -2), [f.dual for f in wanted]
    out = {form: np.zeros(G.shape[:2]) for form in wanted}
    columns = entries_first(G)  # (p, m, unit, frequency)
    inverses = lower = None
    if any(form is not Form.ADDITIVE for form in wanted):
        inverses = pseudo_inverse_first(G)
        lower = lower_factor(inverses)
    step = max(1, _CHUNK // max(1, len(G) // 2))
    for start in range(0, G.shape[1], step):
        part = slice(start, start + step)
        _visit_pairs(
            out,
            columns[..., part],
            None if inverses is None else inverses[..., part],
            None if lower is None else lower[..., part],
            part,
            wide,
        )
    return {form.dual: value for form, value in out.items()} if wide else out


def _visit_pairs(out: dict[Form, Array], G: Array, P: Array | None, L: Array | None, part: slice, wide: bool) -> None:
    """Raise the bounds by all pairs (j, k > j) on one band of frequencies."""
    for j in range(G.shape[2] - 1):
        rest = slice(j + 1, None)
        D = G[:, :, rest] - G[:, :, j : j + 1]
        if Form.ADDITIVE in out:
            _raise(out[Form.ADDITIVE], sigma_max_first(D), j, part, both=True)
        if P is None or L is None:
            continue
        if out.keys() & {Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE, Form.INVERSE_ADDITIVE}:
            _input_side(out, D, P, L, j, part, wide)
        if out.keys() & {Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE}:
            by_rest, by_j = sigma_max_first(multiply(D, L[:, :, rest])), sigma_max_first(multiply(D, L[:, :, j : j + 1]))
            _assign(out, Form.OUTPUT_MULTIPLICATIVE, j, part, nominal_j=by_j, nominal_k=by_rest)
            _assign(out, Form.INVERSE_OUTPUT_MULTIPLICATIVE, j, part, nominal_j=by_rest, nominal_k=by_j)


def _input_side(out: dict[Form, Array], D: Array, P: Array, L: Array, j: int, part: slice, wide: bool) -> None:
    """Both input multiplicative forms and the inverse additive one."""
    rest = slice(j + 1, None)
    X_k, X_j = multiply(P[:, :, rest], D), multiply(P[:, :, j : j + 1], D)
    if out.keys() & {Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE}:
        by_rest, by_j = sigma_max_first(X_k), sigma_max_first(X_j)
        _assign(out, Form.INPUT_MULTIPLICATIVE, j, part, nominal_j=by_j, nominal_k=by_rest)
        _assign(out, Form.INVERSE_INPUT_MULTIPLICATIVE, j, part, nominal_j=by_rest, nominal_k=by_j)
    if Form.INVERSE_ADDITIVE in out:
        by_j, by_rest = sigma_max_first(multiply(X_k, L[:, :, j : j + 1])), sigma_max_first(multiply(X_j, L[:, :, rest]))
        by_j, by_rest = (by_rest, by_j) if wide else (by_j, by_rest)
        _assign(out, Form.INVERSE_ADDITIVE, j, part, nominal_j=by_j, nominal_k=by_rest)


def _assign(out: dict[Form, Array], form: Form, j: int, part: slice, *, nominal_j: Array, nominal_k: Array) -> None:
    """Raise the bound of nominal j by the largest over k, and those of all nominals k by j."""
    if form in out:
        _raise(out[form], nominal_j, j, part, both=False)
        later = out[form][j + 1 :, part]
        np.maximum(later, nominal_k, out=later)


def _raise(bound: Array, sigma: Array, j: int, part: slice, *, both: bool) -> None:
    np.maximum(bound[j, part], sigma.max(axis=0), out=bound[j, part])
    if both:
        later = bound[j + 1 :, part]
        np.maximum(later, sigma, out=later)


def _direct_bounds(form: Form, responses: Array, paper: bool, nominals: Sequence[int]) -> Array:
    """Residual by residual; for the paper's variants and for a few nominals."""
    out = np.zeros((len(nominals), responses.shape[1]))
    for row, j in enumerate(nominals):
        others = np.delete(np.arange(len(responses)), j)
        if len(others):
            out[row] = sigma_max(residual(form, responses[j], responses[others], paper=paper)).max(axis=0)
    return out


def misfit(form: Form | str, nominal: Array, responses: Array, E: Array | None = None) -> Array:
    """Return what the form cannot rebuild: `sigma_max(rebuilt Gp - Gp) / sigma_max(Gp)`.

    Parameters
    ----------
    form : Form or str
    nominal : ndarray, shape (frequency, p, m), complex
    responses : ndarray, shape (unit, frequency, p, m), complex
    E : ndarray, shape (unit, frequency, p', m'), optional
        Residuals, when already computed.

    Returns
    -------
    ndarray, shape (unit, frequency)
        NaN where the matrix that the form inverts has a condition number above 1e12; zero where the plant itself is zero.
    """
    form = as_form(form)
    E = residual(form, nominal, responses) if E is None else E
    error = sigma_max(rebuild(form, nominal, E) - responses)
    size = sigma_max(responses)
    ratio = np.divide(error, size, out=np.zeros_like(error), where=size > 0)
    if form.value.startswith("inverse"):
        ratio[~(condition_number(inverted_matrix(form, nominal, E)) <= MAX_CONDITION)] = np.nan
    return ratio


def completion(form: Form | str, nominal: npt.ArrayLike, responses: npt.ArrayLike) -> tuple[Array, Array]:
    """Return residuals and the additive remainder that completes them: `Gp = rebuild(form, G, E) + R` for every unit and frequency.

    Parameters
    ----------
    form : Form or str
    nominal, responses : array_like, shape (..., p, m), complex
        Leading axes broadcast.

    Returns
    -------
    E : ndarray, shape (..., p', m')
        As `residual`, but zero where the matrix that the form inverts has a condition number above 1e12.
    R : ndarray, shape (..., p, m)
        Zero but for rounding where the form is exact, and `Gp - G` where E was set to zero.
    """
    form, G, Gp = as_form(form), np.asarray(nominal), np.asarray(responses)
    E = residual(form, G, Gp)
    if form.value.startswith("inverse"):
        regular = condition_number(inverted_matrix(form, G, E)) <= MAX_CONDITION
        E = np.where(regular[..., None, None], E, 0.0)
    return E, Gp - rebuild(form, G, E)


def check_responses(responses: npt.ArrayLike) -> Array:
    """Return responses as an array, or say which axes are missing."""
    G = np.asarray(responses)
    if G.ndim != 4 or 0 in G.shape:
        raise DimensionError(f"Responses: need the axes (unit, frequency, output, input), none of them empty; found shape {G.shape}.")
    return G
