r"""Optimal cover of a set of residuals, frequency by frequency: diagonal magnitudes left and right.

A cover `W_L, W_R` is sound when `sigma_max(W_L^-1 E_k W_R^-1) <= 1` for every unit k. With `W_L = s exp(x_l)`, `W_R =
exp(x_r)` and `s = max_k sigma_max(exp(-x_l) E_k exp(-x_r))` every choice of x is sound, and

    mean(log W_L) + mean(log W_R) = mean(x_l) + mean(x_r) + log s(x_l, x_r)

is convex in x (three-lines theorem) and the same for all ways to share a common factor between left and right. The
maximum over units and singular values is smoothed by a Schatten norm of order 2 q,

    log s  ~  1 / (2 q) log sum_k tr (M_k M_k^H)^q,     M_k = exp(-x_l) E_k exp(-x_r)

whose gradient is the marginals of `Y * conj(M)`, `Y = (M M^H)^(q-1) M`; Newton's method runs over all frequencies at
once with q rising to 65, and s is then recomputed without smoothing. A weak pull towards equal entries keeps the
optimum finite where residuals are triangular, and picks the smooth one where it is not unique.

Weights are stable systems that are above a cover, `E_k = W_L Delta_k W_R` with `||Delta_k|| <= 1` at every frequency.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from ...core import EPS, TINY, AnyArray, ArrayLike, StateSpace, frozen
from ...core.linalg import entries_first, multiply, sigma_max_first, squared
from ..forms import evenly
from ..settings import FIT, PROOF
from .proof import ProofMethod

_STEP = np.cbrt(EPS)  # nepers, of differences
NEPER_DB = 20 / np.log(10.0)


@frozen
class Cover:
    """Magnitudes of a cover; one right entry is one at every frequency: the scale between left and right is free."""

    left: AnyArray  # (frequency, p')
    right: AnyArray  # (frequency, m')

    def at(self, rows: AnyArray) -> Cover:
        """Return the cover at some frequencies."""
        return Cover(self.left[rows], self.right[rows])

    def cost(self) -> AnyArray:
        """Return mean log left plus mean log right, nepers, shape (frequency,)."""
        return np.log(self.left).mean(axis=1) + np.log(self.right).mean(axis=1)

    def ratio(self, E: AnyArray) -> AnyArray:
        """Return `sigma_max(W_L^-1 E_k W_R^-1)`, shape (unit, frequency), of residuals at the same frequencies."""
        left, right = (1 / np.maximum(v.T, TINY) for v in (self.left, self.right))
        return sigma_max_first(entries_first(E) * left[:, None, None, :] * right[None, :, None, :])


@frozen
class Weight:
    """Stable, minimum-phase diagonal weights that cover a set of residuals."""

    left: StateSpace  # W_L, p' inputs and outputs
    right: StateSpace  # W_R, m' inputs and outputs
    left_orders: tuple[int, ...]  # of every diagonal entry
    right_orders: tuple[int, ...]
    cover_max: float = np.nan  # largest `sigma_max(W_L^-1 E_k W_R^-1)` over units and the dense grid; at most one
    overbound_db_max: float = np.nan  # dB: largest excess of `Cover.cost` over that of the optimal cover
    method: ProofMethod = ProofMethod.GRID  # how the bound between grid points is known, see `proof`

    def magnitudes(self, freqs_hz: ArrayLike) -> Cover:
        """Return the magnitudes of the diagonals at some frequencies."""
        left, right = (side.frequency_response(freqs_hz) for side in (self.left, self.right))
        return Cover(np.abs(np.einsum("fii->fi", left)), np.abs(np.einsum("fii->fi", right)))


def optimal_cover(E: AnyArray) -> Cover:
    """Return the cover of residuals (unit, frequency, p', m') of least mean log magnitudes."""
    p, x = E.shape[2], np.zeros((sum(E.shape[2:]), E.shape[1]))
    alive = np.flatnonzero(E.any(axis=(0, 2, 3)))
    if alive.size:
        chosen = alive[evenly(len(alive), FIT.covered)]
        x = np.array([np.interp(np.arange(E.shape[1]), chosen, row) for row in _descend(entries_first(E[:, chosen]))])
    right = np.exp(x[p:] - x[p:].mean(axis=0)).T
    right = right / right[:, [int(np.argmax(np.median(right, axis=0)))]]
    shape = Cover(np.exp(x[:p]).T, right)
    return Cover(shape.left * shape.ratio(E).max(axis=0)[:, None], right)


def _descend(E: AnyArray) -> AnyArray:
    """Minimise the smoothed cost of residuals (p', m', unit, frequency) over x of shape (p' + m', frequency)."""
    leading = np.argsort(-sigma_max_first(E), axis=0)[: FIT.units]  # all others are covered by the scale
    E, x = E[:, :, np.unique(leading)], np.zeros((E.shape[0] + E.shape[1], E.shape[3]))
    for squarings in FIT.squarings:
        for _ in range(FIT.steps):
            before, x = x, _newton(partial(_smoothed, E, squarings), x)
            if np.abs(x - before).max() < PROOF.rounding:
                break
    return x


def _smoothed(E: AnyArray, squarings: int, x: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return the smoothed cost, shape (frequency,), and its gradient, shape of x."""
    p, m = E.shape[:2]
    M = E * np.exp(-x[:p])[:, None, None, :] * np.exp(-x[p:])[None, :, None, :]
    # no smaller than the largest singular value, and at most four times
    top = np.sqrt(squared(M).sum(axis=(0, 1)).max(axis=0))
    M = M / top
    wide = p <= m
    other = np.conj(np.swapaxes(M, 0, 1))
    power = multiply(M, other) if wide else multiply(other, M)
    for _ in range(squarings):
        power = multiply(power, power)
    Y = multiply(power, M) if wide else multiply(M, power)
    marginal = (Y * np.conj(M)).real.sum(axis=2)  # over units: (p', m', frequency)
    total = marginal.sum(axis=(0, 1))
    log_s = np.log(top) + np.log(total) / (2 * (2**squarings + 1))
    cost = x[:p].mean(axis=0) + x[p:].mean(axis=0) + log_s + FIT.pull / 2 * (x**2).sum(axis=0)
    gradient = np.concatenate([1 / p - marginal.sum(axis=1) / total, 1 / m - marginal.sum(axis=0) / total])
    return cost, gradient + FIT.pull * x


def _newton(smoothed: Callable[[AnyArray], tuple[AnyArray, AnyArray]], x: AnyArray) -> AnyArray:
    """Take one Newton step, shortened where the cost does not fall; the Hessian from differences of the gradient."""
    cost, gradient = smoothed(x)
    ahead = (x + _STEP * unit[:, None] for unit in np.eye(len(x)))
    hessian = np.stack([(smoothed(other)[1] - gradient).T / _STEP for other in ahead], axis=-1)
    hessian = (hessian + hessian.swapaxes(1, 2)) / 2 + FIT.pull / 1000 * np.eye(len(x))
    step = -np.linalg.solve(hessian, gradient.T[..., None])[..., 0].T
    step *= np.minimum(1.0, 2 / np.maximum(np.abs(step).max(axis=0), TINY))
    slope, length = (gradient * step).sum(axis=0), np.ones(x.shape[1])
    highest = cost + 16 * EPS * (1 + np.abs(cost))  # a step that only rounding tells from a rise is a good one
    while (rises := smoothed(x + length * step)[0] > highest + length * slope / 10).any() and length.min() > 1e-4:
        length = np.where(rises, length / 3, length)
    return x + np.where(rises, 0.0, length) * step
