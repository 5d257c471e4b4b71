"""Choice of the nominal unit: the one with the lowest peak residual, for every form (section IV-C)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from .forms import Form
from .residuals import all_bounds, bounds

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
    peaks_db : ndarray, shape (unit,), dB
        Peak of the bound for every candidate; infinity for units that are none, minus infinity for identical units.
    """

    form: Form
    index: int
    bound: Array
    peaks_db: Array

    @property
    def peak_db(self) -> float:
        """Peak of the chosen nominal's bound, dB."""
        return float(self.peaks_db[self.index])

    def runner_up(self) -> int:
        """Return the second-best candidate, or the best where there is no other."""
        order = np.argsort(self.peaks_db, kind="stable")
        return int(order[min(1, len(order) - 1)])


def choose_nominals(responses: Array, *, candidates: npt.ArrayLike | None = None, paper: bool = False) -> dict[Form, NominalChoice]:
    """Return the nominal with the lowest peak residual, for every form.

    Parameters
    ----------
    responses : ndarray, shape (unit, frequency, p, m), complex
        In scaled coordinates; only pooled units.
    candidates : array_like of bool, shape (unit,), optional
        Which units may be nominal.
    paper : bool
        The published pipeline's residuals (slow).

    Returns
    -------
    dict of Form to NominalChoice

    Raises
    ------
    ConfigError
        When no unit may be nominal.
    """
    allowed = np.ones(len(responses), bool) if candidates is None else np.asarray(candidates, bool)
    if allowed.shape != (len(responses),) or not allowed.any():
        raise ConfigError(f"Nominal: candidates should mark at least one of {len(responses)} units, found shape {allowed.shape}.")
    found = {form: bounds(form, responses, paper=True) for form in Form} if paper else all_bounds(responses)
    return {form: _choose(form, bound, allowed) for form, bound in found.items()}


def _choose(form: Form, bound: Array, allowed: Array) -> NominalChoice:
    with np.errstate(divide="ignore"):
        peaks = np.where(allowed, 20 * np.log10(bound.max(axis=1)), np.inf)
    index = int(np.argmin(peaks))
    return NominalChoice(form, index, bound[index], peaks)
