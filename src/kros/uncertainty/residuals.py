"""Residuals of a population: the largest over the units against some nominals, the misfit of a chosen one, and what completes it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from .forms import MAX_CONDITION, Form, as_form, inverted_matrix, rebuild, residual
from .small_matrices import condition_number, sigma_max

Array = npt.NDArray[Any]


def bounds(form: Form | str, responses: Array, *, paper: bool = False, nominals: Sequence[int] | None = None) -> Array:
    """Return the largest residual over the other units, for every nominal asked for.

    Parameters
    ----------
    form : Form or str
    responses : ndarray, shape (unit, frequency, p, m), complex
        In scaled coordinates.
    paper : bool
        The published pipeline's variants.
    nominals : sequence of int, optional
        All units by default.

    Returns
    -------
    ndarray, shape (nominal, frequency)
    """
    form, G = as_form(form), check_responses(responses)
    rows = range(len(G)) if nominals is None else nominals
    others = (np.delete(G, j, axis=0) for j in rows)
    return np.array([sigma_max(residual(form, G[j], Gp, paper=paper)).max(axis=0, initial=0.0) for j, Gp in zip(rows, others, strict=True)])


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
    if form.inverse:
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
    if form.inverse:
        regular = condition_number(inverted_matrix(form, G, E)) <= MAX_CONDITION
        E = np.where(regular[..., None, None], E, 0.0)
    return E, Gp - rebuild(form, G, E)


def check_responses(responses: npt.ArrayLike) -> Array:
    """Return responses as an array, or say which axes are missing."""
    G = np.asarray(responses)
    if G.ndim != 4 or 0 in G.shape:
        raise DimensionError(f"Responses: need the axes (unit, frequency, output, input), none of them empty; found shape {G.shape}.")
    return G
