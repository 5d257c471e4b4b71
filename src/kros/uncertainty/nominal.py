"""Choice of the nominal: the unit from which all others differ the least (section IV-C)."""

from __future__ import annotations

import numpy as np

from ..core.arrays import AnyArray, ArrayLike, frozen
from ..core.linalg import sigma_max
from ..identify.refine.minimax import smallest_largest
from .forms import Form, as_form, check_responses, residual


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
    every = np.arange(G.shape[1])

    def size(nominal: AnyArray, perturbed: AnyArray) -> AnyArray:
        return sigma_max(residual(form, G[nominal, every], G[perturbed, every]))

    return NominalChoice(*smallest_largest((len(G), len(every)), size))
