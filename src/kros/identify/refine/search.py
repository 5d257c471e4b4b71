"""The one search for parameters: Gauss-Newton steps with Levenberg's damping, for many small problems side by side."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ...core import EPS, TINY, Array, Flags, Whole, frozen

Evaluate = Callable[[Array], Array]


@frozen
class Solution:
    """Where the search ended."""

    V: Array  # (problem, rows, columns)
    cost: Array  # sum of squared residuals, (problem,)


@frozen
class GaussNewton:
    """Minimise sums of squares of r(V) by steps ``(H + mu I) d = J^T r``, ``H = J^T J`` scaled to a unit diagonal.

    Every problem has damping, acceptance and constraint by itself: a step that raises the cost or leaves the constraint
    is not taken.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.identify.refine import GaussNewton
    >>> def evaluate(V):  # r = 3 - V
    ...     rows = np.stack([np.ones(1), 3.0 - V[:, 0, 0]], axis=1)
    ...     return rows[:, :, None] * rows[:, None, :]
    >>> GaussNewton().minimise(evaluate, lambda V: np.ones(1, bool), np.zeros((1, 1, 1))).V.round(6).item()
    3.0
    """

    iterations: int = 15  # at most
    least_gain: float = 1e-3  # converged: a step with the first damping lowers the cost by a smaller share
    damping: float = 1e-3  # first, relative to the unit diagonal: small, since searches start near their minimum
    least_damping: float = 1e-9
    most_damping: float = 1e8  # converged, too: no step with so much damping lowers the cost
    factor: float = 10.0  # by which damping falls after a step that was taken, and grows after another

    def minimise(
        self,
        evaluate: Evaluate,
        admissible: Callable[[Array], Flags],
        V: Array,
        narrowed: Callable[[Whole], Evaluate] | None = None,
    ) -> Solution:
        """Return the minima from the start V (problem, rows, columns).

        Parameters
        ----------
        evaluate : callable
            From V to ``[J r]^T [J r]``, shape (problem, P + 1, P + 1), with J the slopes of what is subtracted from the
            data.
        admissible : callable
            From V to the problems whose constraint holds, shape (problem,).
        V : ndarray, shape (problem, rows, columns)
        narrowed : callable, optional
            From rows of the problems to `evaluate` of these alone, for which a search continues when others have
            converged.
        """
        V, matrix = V.copy(), evaluate(V)
        damping, done = np.full(len(V), self.damping), np.zeros(len(V), dtype=bool)
        rows, used = np.arange(len(V)), 0
        while used < self.iterations and not done.all():
            if narrowed is not None and 4 * np.count_nonzero(~done) <= 3 * len(rows):  # data are copied
                rows = np.flatnonzero(~done)
                evaluate = narrowed(rows)
            now, before, mu = V[rows], matrix[rows], damping[rows]
            trial = now + _step(before, mu).reshape(now.shape)
            allowed = admissible(trial) & ~done[rows]
            after = evaluate(np.where(allowed[:, None, None], trial, now))
            cost, last = after[:, -1, -1], before[:, -1, -1]
            better = allowed & (cost < last)
            small = cost >= (1 - self.least_gain) * last
            stuck = ~better & (mu >= self.most_damping)
            done[rows] |= (better & small & (mu <= self.damping)) | stuck | (last == 0)
            V[rows] = np.where(better[:, None, None], trial, now)
            matrix[rows] = np.where(better[:, None, None], after, before)
            mu = np.where(better, mu / self.factor, mu * self.factor)
            damping[rows] = np.clip(mu, self.least_damping, self.most_damping)
            used += 1
        return Solution(V, matrix[:, -1, -1])


def _step(matrix: Array, mu: Array) -> Array:
    """Solve the damped normal equations in parameters scaled to a unit diagonal."""
    fine = np.all(np.isfinite(matrix), axis=(1, 2))  # a run that diverges gives no direction
    H = np.where(fine[:, None, None], matrix[:, :-1, :-1], np.eye(matrix.shape[-1] - 1))
    g = np.where(fine[:, None], matrix[:, :-1, -1], 0.0)
    diagonal = np.linalg.diagonal(H)
    least = EPS**2 * diagonal.max(axis=1, keepdims=True) + TINY
    scale = 1 / np.sqrt(np.maximum(diagonal, least))
    scaled = H * scale[:, :, None] * scale[:, None, :] + mu[:, None, None] * np.eye(H.shape[-1])
    return np.linalg.solve(scaled, (g * scale)[..., None])[..., 0] * scale


@dataclass(frozen=True)
class RefineOptions:
    """Settings of `refine_population`: errors of channels divided by their ranges, horizons in samples.

    Examples
    --------
    >>> from kros.identify.refine import RefineOptions
    >>> RefineOptions(horizons=(10, 100), segments=8).horizons
    (10, 100)
    """

    # Data of the search
    horizons: tuple[int, ...] = (160, 320, 1000)  # of the free runs, one after the other; the last one is minimised
    segments: int = 24  # stretches of recordings of every unit, spread over its training episodes
    pooled_segments: int = 120  # of all units together, from which the pooled model is sought; it is finished on all
    compared: int = 64  # residuals of a state in a segment, at least: neighbouring errors of a long run say the same
    seed: int = 0  # where the segments start

    # Pooled model
    alpha_factor: float = 4.0  # its EDMD start has this times the smallest alpha that stabilises it
    balance: float = 0.65  # errors count in units of error**balance of EDMD: 0 weighs ranges, 1 the improvement
    least_error: float = 1e-6  # of a state's free run by EDMD: exact data have none to scale by
    row_weight: float = 0.1  # of a lifted function's one-step error, which does not enter free runs

    # Stability
    margin: float = 1e-5  # stable means a spectral radius below one less this
    guard: float = 2e-3  # radii above one less this are penalised: the search slides along the edge of stability
    penalties: int = 8  # decades over which the weight of the edge of stability grows for an unstable model
    bound: float = 10.0  # largest value of a free run on training episodes

    # Prior
    prior_level: float = 0.3  # residual up to which the prior is quadratic; beyond it flattens the residual's peak
    strengths: tuple[float, ...] = (1e3, 1e2, 3e1, 1e1, 3.0, 1.0, 0.3, 0.1, 3e-2, 1e-2, 3e-3, 1e-3)  # strongest first
    patience: int = 3  # strengths over which the held-out error must fall by half of the tolerance
    tolerance: float = 0.1  # the strongest prior whose held-out error exceeds the lowest by at most this is chosen

    # Search
    search: GaussNewton = field(default_factory=GaussNewton)  # at each horizon
    final_iterations: int = 75  # of the units at the strength chosen, at most
    path_iterations: int = 8  # at each strength before one is chosen; each starts where the stronger prior ended
