r"""Weights: diagonal systems left and right that bound the residuals of all units, at every frequency, as used.

    E_k = W_L Delta_k W_R,   ||Delta_k|| <= 1      w2 ──> W_L ──>   and   ──> W_R ──> z2

Entrywise weights bound every entry of the residual by itself, for a diagonal perturbation:

    E_ij = W_ij delta_ij,  |delta_ij| <= 1        E = L diag(delta_11, delta_12, ...) R

L picks rows, R holds the weights: entry (i, j) is the dyad of row `e_i` of L and `W_ij e_j^T` of R. The paper bounds
residuals this way (its Figure 8) and then puts `W Delta` with a full Delta into its generalized plant. For that set the
bound does not hold: `|W_ij| >= |E_ij|` says nothing about `sigma_max(W^-1 E)`, which `unstructured_excess` measures.
With the diagonal Delta it holds, and mu analysis can use it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace, dense_response, gain
from ...core.small_matrices import sigma_max
from .certificate import Method
from .cover import Cover, Structure

Array = npt.NDArray[Any]

_SINGULAR = 1e10  # condition number beyond which entrywise weights have no inverse


@dataclass(frozen=True, eq=False)
class Weight:
    """Stable, minimum-phase diagonal weights that cover a set of residuals.

    Parameters
    ----------
    left : StateSpace
        W_L, p' inputs and outputs.
    right : StateSpace
        W_R, m' inputs and outputs.
    left_orders, right_orders : tuple of int
        Order of every diagonal entry.
    structure : Structure
    cover_max : float
        Largest `sigma_max(W_L^-1 E_k W_R^-1)` over units and the dense grid, for the weights as used; at most one.
    overbound_db_max : float, dB
        Largest excess over the grid of `mean_i log left_i + mean_j log right_j`, by which covers are compared, over the
        optimal cover.
    within_tolerance : bool
        Whether the overbound of the weight as returned, at every frequency of the grid, is within the tolerance asked
        for: `overbound_db_max`, and of entrywise weights that of every entry.
    method : Method
        How the bound between grid points is known, see `certificate`.
    remaining_margin : float
        One minus the largest ratio over all frequencies: by level sets a bound on it, on a grid what was found.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import StateSpace
    >>> from kros.uncertainty import quantify
    >>> gains = np.array([0.9, 1.0, 1.2])[:, None, None]
    >>> units = StateSpace(np.full((3, 1, 1), 0.5), gains, np.ones((3, 1, 1)), np.zeros((3, 1, 1)), 0.01)
    >>> weight = quantify(units, "output_multiplicative").weight
    >>> weight.structure.value, weight.cover_max <= 1
    ('diagonal', True)
    """

    left: StateSpace
    right: StateSpace
    left_orders: tuple[int, ...]
    right_orders: tuple[int, ...]
    structure: Structure
    cover_max: float
    overbound_db_max: float
    within_tolerance: bool = True
    method: Method = Method.GRID
    remaining_margin: float = float("nan")

    def magnitudes(self, freqs_hz: npt.ArrayLike) -> Cover:
        """Return the magnitudes of the diagonals at some frequencies."""
        left, right = (dense_response(side, freqs_hz) for side in (self.left, self.right))
        return Cover(np.abs(np.einsum("fii->fi", left)), np.abs(np.einsum("fii->fi", right)))

    def matrix(self) -> StateSpace:
        """Return the p' by m' system `W_L 1 W_R`, with 1 a matrix of ones."""
        ones = gain(np.ones((self.left.n_inputs, self.right.n_outputs)), self.left.dt)
        return self.left @ ones @ self.right

    def mapped(self, change: Callable[[StateSpace], StateSpace]) -> Weight:
        """Return the weight with its systems changed, for example to another time."""
        return replace(self, left=change(self.left), right=change(self.right))

    def scaled(self, factor: float) -> Weight:
        """Return the weight with its left part multiplied."""
        left = self.left
        return replace(self, left=StateSpace(left.A, left.B, left.C * factor, left.D * factor, left.dt))

    def measured(self, freqs_hz: Array, best: Cover, tolerance_db: float) -> Weight:
        """Return the weight with its overbounds over the optimal cover at some frequencies."""
        used, some = self.magnitudes(freqs_hz), best.left.min(axis=1) > 0
        excess = float((used.at(some).cost_db() - best.at(some).cost_db()).max()) if some.any() else 0.0
        return replace(self, overbound_db_max=excess, within_tolerance=excess <= tolerance_db)


@dataclass(frozen=True, eq=False)
class EntrywiseWeight(Weight):
    """Bounds of every entry, sound for a diagonal perturbation only."""

    unstructured_excess: float = float("nan")  # largest `sigma_max(W^-1 E_k)` over units and the dense grid

    def magnitudes(self, freqs_hz: npt.ArrayLike) -> Cover:
        """Return ones, and the magnitudes of the weights row by row, shape (frequency, p' m')."""
        rows = np.arange(self.right.n_outputs)
        values = np.abs(self.right.frequency_response(freqs_hz)[:, rows, rows % self.right.n_inputs])
        return Cover(np.ones_like(values), values)

    def matrix(self) -> StateSpace:
        """Return the matrix of weights, p' by m'; the bounds of the entries."""
        return self.left @ self.right


def unstructured_excess(W: Array, E: Array) -> float:
    """Return the largest ``sigma_max(W^-1 E)`` of entrywise weights (frequency, p, p) over residuals."""
    if W.shape[-1] != W.shape[-2] or not np.abs(W).max():
        return float("nan")
    usable = np.linalg.cond(W) < _SINGULAR
    return float(sigma_max(np.linalg.solve(W[usable], E[:, usable])).max()) if usable.any() else float("nan")
