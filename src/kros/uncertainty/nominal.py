"""Choice of the nominal: the unit from which all others differ the least (section IV-C)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from ..core.small_matrices import entries_first, lower_factor, multiply, pseudo_inverse_first, sigma_max_first
from ..identify.refine.minimax import smallest_largest
from .forms import Form, as_form, check_responses
from .settings import SET

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
        raise DimensionError(f"Nominal: units {np.flatnonzero(broken)[:5]} have NaN or infinity; leave them out.")
    count, n_freqs = G.shape[:2]
    step, plants = max(1, SET.at_once // n_freqs), _Plants.of(form, G)

    def against(rows: Array, witness: Array) -> Array:
        """Residuals of the witness of every frequency for some nominals, shape (nominal, frequency)."""
        units = plants.at(witness, np.arange(n_freqs)).at(None)
        return np.concatenate([plants.at(rows[k : k + step]).sigma(units) for k in range(0, len(rows), step)])

    def bound(row: int) -> tuple[Array, Array]:
        """Largest residual over the units and which unit it is, shape (frequency,)."""
        nominal = plants.at(slice(row, row + 1))
        sizes = np.concatenate([nominal.sigma(plants.at(slice(k, k + step))) for k in range(0, count, step)])
        return sizes.max(axis=0), sizes.argmax(axis=0)

    best = smallest_largest((count, n_freqs), _central(G), bound, against, lambda sizes: sizes.max(axis=-1))
    index, largest, scores, evaluated = best
    with np.errstate(divide="ignore"):
        return NominalChoice(form, index, largest, 20 * np.log10(scores), evaluated)


def _central(G: Array) -> int:
    """Return the unit closest to the mean at a few frequencies, to begin with."""
    some = G[:, np.linspace(0, G.shape[1] - 1, 8).astype(int)]
    distance = np.abs(some - some.mean(axis=0)).max(axis=(2, 3))
    return int(np.argmin((distance / np.maximum(distance.max(axis=0), np.finfo(float).tiny)).max(axis=1)))


@dataclass(frozen=True, eq=False)
class _Plants:
    """Responses and what residuals need of them, entries first: (p, m, unit, frequency)."""

    form: Form
    G: Array
    P: Array  # (m, p, unit, frequency): pseudo-inverses
    R: Array  # factors on the right with `P P^H = R R^H`, so that `sigma(D P) = sigma(D R)`

    @classmethod
    def of(cls, form: Form, responses: Array) -> _Plants:
        G = entries_first(responses)
        P = G if form is Form.ADDITIVE else pseudo_inverse_first(responses)
        return cls(form, G, P, P if form is Form.ADDITIVE or len(P) > len(G) else lower_factor(P))

    def at(self, *index: Any) -> _Plants:
        """Return some units and frequencies; two integer arrays are matched."""
        key = (slice(None), slice(None), *index)
        return _Plants(self.form, self.G[key], self.P[key], self.R[key])

    def sigma(self, units: _Plants) -> Array:
        """Return the largest singular value of the residuals of units; the axes of units and frequencies broadcast."""
        D, base = units.G - self.G, units if self.form.inverse else self
        if self.form is Form.ADDITIVE:
            return sigma_max_first(D)
        if self.form is Form.INVERSE_ADDITIVE:
            return sigma_max_first(multiply(multiply(units.P, D), self.R))
        left = self.form in (Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE)
        return sigma_max_first(multiply(base.P, D) if left else multiply(D, base.R))
