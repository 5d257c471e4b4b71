"""Choice of the nominal: the unit from which all others differ the least (section IV-C)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError
from ..forms import Form, as_form, check_responses
from .search import Geometry, search

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class NominalChoice:
    """Best nominal of one form.

    Parameters
    ----------
    form : Form
    index : int
        Row of the chosen unit.
    bound : ndarray, shape (frequency,)
        Largest residual over the other units.
    scores_db : ndarray, shape (unit,), dB
        Peak residual against every unit; minus infinity for identical units.
    evaluated : ndarray of bool, shape (unit,)
        Where a score is exact; elsewhere it is a lower bound, which proves that the unit is no better.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import choose_nominal
    >>> choice = choose_nominal(np.array([0.8, 1.0, 1.1]).reshape(3, 1, 1, 1), "additive")
    >>> choice.index, choice.bound.round(9).tolist()
    (1, [0.2])
    """

    form: Form
    index: int
    bound: Array
    scores_db: Array
    evaluated: Array

    @property
    def peak_db(self) -> float:
        """Peak of the chosen nominal's bound, dB."""
        with np.errstate(divide="ignore"):
            return float(20 * np.log10(self.bound.max()))


def choose_nominal(responses: npt.ArrayLike, form: Form | str) -> NominalChoice:
    """Return the unit with the lowest peak residual against all others; exact, and without visiting all pairs of units.

    Parameters
    ----------
    responses : array_like, shape (unit, frequency, p, m), complex
        In scaled coordinates; only pooled units.
    form : Form or str

    Returns
    -------
    NominalChoice

    Raises
    ------
    ConfigError
        When the form is unknown.
    DimensionError
        When responses do not have these axes, or have NaN.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import choose_nominal
    >>> gains = np.array([1.0, 2.0, 9.0]).reshape(3, 1, 1, 1) + 0j
    >>> choose_nominal(gains, "additive").index
    1
    """
    form, G = as_form(form), check_responses(responses)
    broken = ~np.isfinite(G).all(axis=(1, 2, 3))
    if broken.any():
        raise DimensionError(
            f"Nominal: responses of units {np.flatnonzero(broken)[:5]} have NaN or infinity; leave them out."
        )
    geometry = Geometry.of(form, (G.shape[2], G.shape[3]))
    index, bound, scores, evaluated = search(geometry, geometry.plants(G))
    with np.errstate(divide="ignore"):
        return NominalChoice(form, index, bound, 20 * np.log10(scores), evaluated)


def choose_nominals(responses: npt.ArrayLike) -> dict[Form, NominalChoice]:
    """Return the best nominal of every form."""
    return {form: choose_nominal(responses, form) for form in Form}
