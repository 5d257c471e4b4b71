r"""Residuals of every unit beside weights, in both readings: entry by entry as in the paper's figures, and as a cover.

    |E_ij|                       against  |W_ij|, the best fit to the largest of the covered units    entrywise
    sigma_max(W_L^-1 E W_R^-1)   against  one                                                         sound

Pictures of an uncertain model and of an outlier show it; a unit that the weights were not made for exceeds one. The
paper bounds every entry by itself (its Figure 8) and puts `W Delta` with a full Delta into its generalized plant. For
that set the bound does not hold: it says nothing about `sigma_max(W^-1 E)`, which `excess` measures. kros shows these
weights and designs the paper's own observer with them; its sets have diagonal weights (`weights.cover`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import partial

import numpy as np

from ..core import AnyArray, Names, StateSpace, Storable, block_diagonal, frozen, gain
from ..core.linalg import sigma_max
from .forms import Form, residual
from .settings import SET
from .weights.cover import Cover
from .weights.magnitude import fit_magnitude


@frozen
class UnitResiduals(Storable):
    """Sizes of the residuals of many units against one nominal."""

    KIND = "unit_residuals"
    form: Form
    nominal_id: str
    unit_ids: Names  # covered units, and others
    outside: Names  # units that the weights do not have to cover
    freqs_hz: AnyArray  # (frequency,), Hz
    entries: AnyArray  # (unit, frequency, p', m'): magnitudes of the residual's entries, in scaled coordinates
    ratio: AnyArray  # (unit, frequency): ``sigma_max(W_L^-1 E W_R^-1)``
    largest: AnyArray  # (frequency, p', m'): largest entries of all covered units
    entry_weights: AnyArray  # (frequency, p', m')
    entry_orders: AnyArray  # (p', m')
    entry_excess: float

    def rows(self, *, inside: bool) -> list[int]:
        """Return rows of the units that are covered, or of those that need not be."""
        return [k for k, unit in enumerate(self.unit_ids) if (unit not in self.outside) is inside]


def unit_residuals(
    form: Form,
    nominal: tuple[str, AnyArray],
    responses: Mapping[str, AnyArray],
    cover: Cover,
    freqs_hz: AnyArray,
    sample_period_s: float,
    outside: Collection[str] = (),
) -> UnitResiduals:
    """Return residuals of units, whose responses have the shape (frequency, p, m), beside a cover."""
    unit_ids, inside = tuple(responses), np.array([unit not in outside for unit in responses])
    E = residual(form, nominal[1], np.stack(list(responses.values())))
    names = form, nominal[0], unit_ids, tuple(unit for unit in unit_ids if unit in outside)
    fitted = fit_entries(E[inside], freqs_hz, sample_period_s, SET.entry_order)
    fit = np.abs(fitted.system.frequency_response(freqs_hz)), fitted.orders, fitted.excess
    return UnitResiduals(*names, freqs_hz, np.abs(E), cover.ratio(E), np.abs(E[inside]).max(axis=0), *fit)


@frozen
class EntryWeights:
    """Bounds of entries at frequencies."""

    system: StateSpace  # p' by m'
    orders: AnyArray  # (p', m')
    excess: float  # largest `sigma_max(W^-1 E_k)`: above one, a full perturbation does not cover the residuals


def fit_entries(
    E: AnyArray, freqs_hz: AnyArray, sample_period_s: float, max_order: int, tolerance_db: float = SET.entry_db
) -> EntryWeights:
    """Return one magnitude for every entry of residuals (unit, frequency, p', m')."""
    p, m = E.shape[2:]
    sizes = np.abs(E).max(axis=0).reshape(len(freqs_hz), p * m).T
    fit = partial(fit_magnitude, max_order=max_order, tolerance_db=tolerance_db)
    fits = [fit(freqs_hz, size, sample_period_s) for size in sizes]
    sums, copies = (gain(M, sample_period_s) for M in (np.kron(np.eye(p), np.ones(m)), np.tile(np.eye(m), (p, 1))))
    system = sums @ block_diagonal([fit.system for fit in fits]) @ copies
    orders = np.array([fit.order for fit in fits]).reshape(p, m)
    return EntryWeights(system, orders, _excess(system.frequency_response(freqs_hz), E))


def _excess(W: AnyArray, E: AnyArray) -> float:
    """Return the largest ``sigma_max(W^-1 E)`` of weights (frequency, p, p) over residuals."""
    if W.shape[-1] != W.shape[-2] or not np.abs(W).max():
        return float("nan")
    usable = np.linalg.cond(W) < SET.singular
    return float(sigma_max(np.linalg.solve(W[usable], E[:, usable])).max()) if usable.any() else float("nan")
