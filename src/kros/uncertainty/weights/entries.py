r"""The paper's weights: a bound of every entry of the residuals by itself, `|W_ij| >= |E_ij|` (its Figure 8).

The paper puts `W Delta` with a full Delta into its generalized plant. For that set the bound does not hold: it says
nothing about `sigma_max(W^-1 E)`, which `excess` measures. kros shows these weights and designs the paper's own
observer with them; its sets have diagonal weights (`weight`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace, block_diagonal, gain
from ...core.small_matrices import sigma_max
from .magnitude import fit_magnitude

Array = npt.NDArray[Any]

_SINGULAR = 1e10  # condition number beyond which weights have no inverse


@dataclass(frozen=True, eq=False)
class EntryWeights:
    """Bounds of entries at frequencies."""

    system: StateSpace  # p' by m'
    orders: Array  # (p', m')
    excess: float  # largest `sigma_max(W^-1 E_k)`: above one, a full perturbation does not cover the residuals


def fit_entries(
    E: Array, freqs_hz: Array, sample_period_s: float, max_order: int = 4, tolerance_db: float = 1.0
) -> EntryWeights:
    """Return one magnitude for every entry of residuals (unit, frequency, p', m')."""
    p, m = E.shape[2:]
    options: dict[str, Any] = {"max_order": max_order, "tolerance_db": tolerance_db}
    sizes = np.abs(E).max(axis=0).reshape(len(freqs_hz), p * m).T
    fits = [fit_magnitude(freqs_hz, size, sample_period_s, **options) for size in sizes]
    rows, columns = np.kron(np.eye(p), np.ones((1, m))), np.tile(np.eye(m), (p, 1))
    entries = block_diagonal([fit.system for fit in fits])
    system = gain(rows, sample_period_s) @ entries @ gain(columns, sample_period_s)
    orders = np.array([fit.order for fit in fits]).reshape(p, m)
    return EntryWeights(system, orders, _excess(system.frequency_response(freqs_hz), E))


def _excess(W: Array, E: Array) -> float:
    """Return the largest ``sigma_max(W^-1 E)`` of weights (frequency, p, p) over residuals."""
    if W.shape[-1] != W.shape[-2] or not np.abs(W).max():
        return float("nan")
    usable = np.linalg.cond(W) < _SINGULAR
    return float(sigma_max(np.linalg.solve(W[usable], E[:, usable])).max()) if usable.any() else float("nan")
