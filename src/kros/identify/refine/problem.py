"""What is minimised: free-run error of states, one-step error of lifted functions, distance from the pooled model.

    sum ||(x_data - x_free_run) / sigma||^2  +  sum ||(sigma+ - w psi) / sigma_row||^2  +  edge of stability  +  prior

The edge of stability is soft: a search that only rejects unstable models stops where it first meets the edge, this one
slides along it.

    edge = weight sum_i max(0, (|lambda_i| - 1 + guard) / guard)^2
    d|lambda| = Re[conj(lambda) / |lambda|  y^H dA x / (y^H x)]

with right and left eigenvectors x, y of A, and ``dA = (dV T^T)`` without its columns of inputs.

A free run retracts and re-lifts, so the rows of the lifted functions do not enter it; they enter only the linear model
used in synthesis, and are fitted one step ahead, from the triangular factors.

Symbols
-------
V : free parameters, (unit, n_lifted, p);  W = V T^T;  P = n_lifted p
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...core import TINY, Array, Flags, Whole, frozen
from ...core.linalg import spectral_radius
from ...lifting import Lifting
from ..edmd import KoopmanMatrices
from ..factors import Factor
from .metric import ResponsePrior
from .search import RefineOptions
from .segments import Segments
from .sensitivity import Normal, normal_equations


@frozen
class OneStep:
    """Normal equations of the lifted functions' rows."""

    matrix: Array  # (unit, p + f, p + f)
    least: Array  # (unit, f)
    variance: Array  # (f,)

    @classmethod
    def of(cls, factor: Factor, T: Array, n_states: int, pooled: Whole, least_variance: float = 1e-10) -> OneStep:
        """Read them from factors of ``[Psi | Theta_plus]``; `pooled` units set the variance.

        The variance is at least a share of the function's mean square: an earlier value is predicted exactly.
        """
        p = len(T)
        white = np.concatenate([factor.R[..., :p] @ T, factor.R[..., p + n_states :]], axis=-1)
        matrix = white.mT @ white / factor.n_samples[:, None, None]
        mean = matrix[pooled].mean(axis=0)
        least = np.stack([_unexplained(M, p) for M in matrix])
        return cls(matrix, least, np.maximum(_unexplained(mean, p), least_variance * np.diagonal(mean[p:, p:])))

    def normal(self, rows: Array, row: int) -> Array:
        """Return ``[J r]^T [J r]`` of one function for rows (unit, p), per sample and in units of its variance."""
        p = rows.shape[-1]
        G, c = self.matrix[:, :p, :p], self.matrix[:, :p, p + row]
        slope = c - (G @ rows[..., None])[..., 0]
        power = self.matrix[:, p + row, p + row] - np.sum(rows * (c + slope), axis=-1)
        cost = np.maximum(power - self.least[:, row], 0.0)
        return np.block([[G, slope[..., None]], [slope[:, None], cost[:, None, None]]]) / self.variance[row]


@frozen
class RefinementProblem:
    """Least squares of all units at one horizon."""

    lifting: Lifting
    parameters: Mapping[str, Array]  # (unit,)
    segments: Segments
    T: Array  # (p, p)
    sigma: Array  # (n,)
    one_step: OneStep
    options: RefineOptions
    pooled: bool = False  # one model for all units
    edged: bool = False  # whether the edge of stability counts
    prior: ResponsePrior | None = None
    counted: float | None = None  # residuals of the problem that this is a part of

    @property
    def residuals(self) -> float:
        """Residuals that one unit's free runs contribute, on average."""
        if self.counted is not None:
            return self.counted
        return self.lifting.n_states * float(self.segments.compared.sum()) / self.segments.n_units / self.stride

    @property
    def stride(self) -> int:
        """Every how many steps the error counts."""
        return max(1, self.segments.horizon // self.options.compared)

    @property
    def edge_weight(self) -> float:
        """Weight of the edge of stability: that of all residuals."""
        return self.residuals * (self.segments.n_units if self.pooled else 1)

    def at(self, horizon: int) -> RefinementProblem:
        """Return the same problem at a horizon up to that of the segments."""
        return replace(self, segments=self.segments.cut(horizon))

    def of_units(self, rows: Whole) -> RefinementProblem:
        """Return the problem of some units, with the same weights."""
        values = {name: given[rows] for name, given in self.parameters.items()}
        one_step = replace(self.one_step, matrix=self.one_step.matrix[rows], least=self.one_step.least[rows])
        part = replace(self, parameters=values, segments=self.segments.units(rows), one_step=one_step)
        return replace(part, counted=self.residuals)

    def of_one_model(self, rows: Whole) -> RefinementProblem:
        """Return the problem of one model for some units."""
        return replace(self.of_units(rows), pooled=True, counted=None)

    def with_prior(self, strength: float) -> RefinementProblem:
        """Return the problem with a prior in proportion to the residuals that a unit's free runs have."""
        assert self.prior is not None
        return replace(self, prior=replace(self.prior, weight=strength * self.residuals))

    def admissible(self, V: Array) -> Flags:
        """Return which models are finite and stable as linear systems."""
        A = self.matrices(V).A
        finite = self.finite(A)
        return finite & (spectral_radius(np.where(finite[..., None, None], A, 0.0)) < 1 - self.options.margin)

    def matrices(self, V: Array) -> KoopmanMatrices:
        """Return A and B of whitened parameters."""
        W, n_lifted = V @ self.T.T, self.lifting.n_lifted
        return KoopmanMatrices(W[..., :n_lifted], W[..., n_lifted:])

    def finite(self, V: Array) -> Flags:
        """Return which models hold numbers only."""
        return np.all(np.isfinite(V), axis=(-1, -2))

    def run(self, V: Array) -> Normal:
        """Return the normal equations of the free runs alone."""
        n = self.lifting.n_states
        each = np.broadcast_to(V[:, :n], (self.segments.n_units, n, V.shape[-1]))
        return normal_equations(each, self.T, self.lifting, self.parameters, self.segments, self.sigma, self.stride)

    def evaluate(self, V: Array) -> Array:
        """Return ``[J r]^T [J r]`` of the whole cost, shape (problem, P + 1, P + 1)."""
        n, nl, p = self.lifting.n_states, self.lifting.n_lifted, V.shape[-1]
        normal = self.run(V)
        each = np.broadcast_to(V, (len(normal.matrix), nl, p))
        total = np.zeros((len(each), nl * p + 1, nl * p + 1))
        _add(total, normal.matrix, np.arange(n * p))
        weight = self.options.row_weight * normal.counts[:, None, None]
        for row in range(n, nl):
            _add(total, weight * self.one_step.normal(each[:, row], row - n), row * p + np.arange(p))
        total = total.sum(axis=0, keepdims=True) if self.pooled else total
        if self.edged:
            total += stability_barrier(V, self.T, self.options.guard, self.edge_weight)
        if self.prior is not None:
            total += self.prior.normal(V)
        return total


def _unexplained(M: Array, p: int) -> Array:
    """Return the mean squares of functions that the best rows leave, from the matrix of all products."""
    best = np.linalg.lstsq(M[:p, :p], M[:p, p:], rcond=None)[0]
    return np.diagonal(M[p:, p:]) - np.sum(best * M[:p, p:], axis=0)


def _add(total: Array, part: Array, place: Whole) -> None:
    """Add normal equations of some parameters."""
    at = np.append(place, -1)
    total[:, at[:, None], at] += part


def stability_barrier(V: Array, T: Array, guard: float, weight: float) -> Array:
    """Return ``[J r]^T [J r]`` of the edge above, shape (problem, n p + 1, n p + 1)."""
    problems, n, p = V.shape
    values, right = np.linalg.eig((V @ T.T)[..., :n])
    size = np.abs(values)
    excess = np.maximum(0.0, (size - 1 + guard) / guard)  # (problem, eigenvalue)
    left = np.linalg.pinv(right)  # rows y^H, with y^H x = 1
    turn = np.conj(values) / np.maximum(size, TINY)
    columns = right.mT @ T[:n]  # x^T of every eigenvalue, through dA = dV T^T
    slope = (turn[..., None, None] * left[..., :, None] * columns[..., None, :]).real.reshape(problems, n, n * p)
    J = np.where(excess[..., None] > 0, slope / guard, 0.0)
    rows = np.sqrt(weight) * np.concatenate([J, -excess[..., None]], axis=-1)
    return rows.mT @ rows
