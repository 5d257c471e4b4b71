r"""Weights: diagonal systems left and right that bound the residuals of all units, at every frequency, as used.

E_k = W_L Delta_k W_R,   ||Delta_k|| <= 1      w2 ──> W_L ──>   and   ──> W_R ──> z2
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace, gain
from .certificate import Method
from .cover import Cover

Array = npt.NDArray[Any]


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
    cover_max : float
        Largest `sigma_max(W_L^-1 E_k W_R^-1)` over units and the dense grid, for the weights as used; at most one.
    overbound_db_max : float, dB
        Largest excess over the grid of `mean_i log left_i + mean_j log right_j`, by which covers are compared, over the
        optimal cover.
    within_tolerance : bool
        Whether the overbound of the weight as returned is within the tolerance at every frequency of the grid.
    method : Method
        How the bound between grid points is known, see `certificate`.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import StateSpace
    >>> from kros.uncertainty import quantify
    >>> gains = np.array([0.9, 1.0, 1.2])[:, None, None]
    >>> units = StateSpace(np.full((3, 1, 1), 0.5), gains, np.ones((3, 1, 1)), np.zeros((3, 1, 1)), 0.01)
    >>> weight = quantify(units, "output_multiplicative").weight
    >>> weight.left_orders, weight.cover_max <= 1
    ((0,), True)
    """

    left: StateSpace
    right: StateSpace
    left_orders: tuple[int, ...]
    right_orders: tuple[int, ...]
    cover_max: float
    overbound_db_max: float
    within_tolerance: bool = True
    method: Method = Method.GRID

    def magnitudes(self, freqs_hz: npt.ArrayLike) -> Cover:
        """Return the magnitudes of the diagonals at some frequencies."""
        left, right = (side.frequency_response(freqs_hz) for side in (self.left, self.right))
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
        """Return the weight with its overbound over the optimal cover at some frequencies."""
        used, some = self.magnitudes(freqs_hz), best.left.min(axis=1) > 0
        excess = float((used.at(some).cost_db() - best.at(some).cost_db()).max()) if some.any() else 0.0
        return replace(self, overbound_db_max=excess, within_tolerance=excess <= tolerance_db)
