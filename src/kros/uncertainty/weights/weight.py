r"""Weights: diagonal systems left and right that bound the residuals of all units, at every frequency, as used.

E_k = W_L Delta_k W_R,   ||Delta_k|| <= 1      w2 ──> W_L ──>   and   ──> W_R ──> z2
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from .cover import Cover
from .proof import Method

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Weight:
    """Stable, minimum-phase diagonal weights that cover a set of residuals."""

    left: StateSpace  # W_L, p' inputs and outputs
    right: StateSpace  # W_R, m' inputs and outputs
    left_orders: tuple[int, ...]  # of every diagonal entry
    right_orders: tuple[int, ...]
    cover_max: float  # largest `sigma_max(W_L^-1 E_k W_R^-1)` over units and the dense grid, as used; at most one
    overbound_db_max: float  # dB: largest excess of `Cover.cost_db` over the optimal cover
    method: Method = Method.GRID  # how the bound between grid points is known, see `proof`

    def magnitudes(self, freqs_hz: npt.ArrayLike) -> Cover:
        """Return the magnitudes of the diagonals at some frequencies."""
        left, right = (side.frequency_response(freqs_hz) for side in (self.left, self.right))
        return Cover(np.abs(np.einsum("fii->fi", left)), np.abs(np.einsum("fii->fi", right)))

    def mapped(self, change: Callable[[StateSpace], StateSpace]) -> Weight:
        """Return the weight with its systems changed, for example to another time."""
        return replace(self, left=change(self.left), right=change(self.right))

    def scaled(self, factor: float) -> Weight:
        """Return the weight with its left part multiplied."""
        left = self.left
        return replace(self, left=StateSpace(left.A, left.B, left.C * factor, left.D * factor, left.dt))

    def measured(self, freqs_hz: Array, best: Cover) -> Weight:
        """Return the weight with its overbound over the optimal cover at some frequencies."""
        used, some = self.magnitudes(freqs_hz), best.left.min(axis=1) > 0
        excess = (used.at(some).cost_db() - best.at(some).cost_db()).max(initial=0.0) if some.any() else 0.0
        return replace(self, overbound_db_max=float(excess))
