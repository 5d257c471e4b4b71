"""Choice of the nominal: the unit from which all others differ the least (section IV-C)."""

from __future__ import annotations

import numpy as np

from ..core.arrays import AnyArray, ArrayLike, frozen
from ..core.linalg import sigma_max
from ..identify.refine.minimax import smallest_largest
from .forms import Form, as_form, check_responses, residual
from .settings import SET


@frozen
class NominalChoice:
    """Best nominal of one form."""

    index: int  # row of the chosen unit
    bound: AnyArray  # (frequency,): largest residual over the other units


def choose_nominal(responses: ArrayLike, form: Form | str) -> NominalChoice:
    """Return the unit with the lowest peak residual against all others; exact, and without visiting all pairs of units.

    Parameters
    ----------
    responses : array_like, shape (unit, frequency, p, m), complex
        In scaled coordinates; only pooled units.
    form : Form or str

    Returns
    -------
    NominalChoice
        With ``index``, the row of the unit, and ``bound``, the largest residual over the others, shape (frequency,).

    Raises
    ------
    ConfigError
        When the form is unknown.
    DimensionError
        When responses do not have these axes.
    DataError
        When one is not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import choose_nominal
    >>> gains = np.array([1.0, 2.0, 9.0]).reshape(3, 1, 1, 1) + 0j
    >>> choice = choose_nominal(gains, "additive")
    >>> choice.index, choice.bound.tolist()
    (1, [7.0])
    """
    form, G = as_form(form), check_responses(responses)
    n_units, n_freqs = G.shape[:2]
    step = max(1, SET.at_once // n_freqs)

    def against(rows: AnyArray, witness: AnyArray) -> AnyArray:
        """Residuals of the witness of every frequency for some nominals, shape (nominal, frequency)."""
        parts, worst = np.split(rows, range(step, len(rows), step)), G[witness, np.arange(n_freqs)]
        return np.concatenate([sigma_max(residual(form, G[part], worst)) for part in parts])

    def bound(row: int) -> tuple[AnyArray, AnyArray]:
        """Largest residual over the units and which unit it is, shape (frequency,)."""
        parts = (G[k : k + step] for k in range(0, n_units, step))
        sizes = np.concatenate([sigma_max(residual(form, G[row], part)) for part in parts])
        return sizes.max(axis=0), sizes.argmax(axis=0)

    return NominalChoice(*smallest_largest((n_units, n_freqs), bound, against)[:2])
