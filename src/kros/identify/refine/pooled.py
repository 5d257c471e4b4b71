"""The pooled model: EDMD on all units together, then free-run error at growing horizons, from several weighings of the states."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...core.errors import IdentificationError
from ...core.linalg import qr_triangle
from ...lifting import Lifting
from ..edmd import KoopmanMatrices, edmd, smallest_stabilising_alpha
from ..factors import Factor
from ..ranges import Ranges
from .marquardt import minimise
from .options import ALPHA_FACTOR, GUARD, LEAST_GAIN, RefineOptions
from .problem import OneStep, RefinementProblem, stability_barrier
from .segments import Segments

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
_COMPARED = 4  # steps within the edge of stability before starts are compared
_HEAVIER = 8  # decades over which the edge of stability grows
_LEAST_ERROR = 1e-6  # relative to a state's range: exact data have no error to scale by


def start_pooled(
    lifting: Lifting,
    parameters: Mapping[str, Array],
    factor: Factor,
    segments: Segments,
    rows: npt.NDArray[np.int64],
    options: RefineOptions,
) -> tuple[Array, RefinementProblem, Array, Array]:
    """Pooled EDMD in whitened parameters (1, n_lifted, p), the problem of all units without a prior, errors and ranges of states."""
    nl, n = lifting.n_lifted, lifting.n_states
    R = qr_triangle(factor.R[rows].reshape(-1, factor.R.shape[-1]))
    p = R.shape[-1] - nl
    alpha = ALPHA_FACTOR * smallest_stabilising_alpha([(R[None], nl)], options.margin)
    matrices = edmd(R, nl, alpha)
    T = _whitening(R[:p, :p], int(factor.n_samples[rows].sum()))
    V = np.linalg.solve(T, np.concatenate([matrices.A, matrices.B], axis=-1).T).T[None]
    one_step = OneStep.of(factor.R, T, n, nl, factor.n_samples, rows)
    problem = RefinementProblem(lifting, parameters, segments, T, np.ones(n), one_step, options.margin)
    normal = restrict(problem, rows).run(V)
    with np.errstate(invalid="ignore"):
        error = np.sqrt(normal.squares.sum(axis=0) / normal.counts.sum())
    span = ranges(factor, rows, lifting)[0][:n]
    error = np.clip(np.where(np.isfinite(error), error, span), _LEAST_ERROR * span, span)
    return V, replace(problem, sigma=_sigma(error, span, options.balance)), error, span


def refine_pooled(
    V: Array,
    problem: RefinementProblem,
    error: Array,
    span: Array,
    score: Callable[[Array], float],
    options: RefineOptions,
) -> Array:
    """Fit one model to all units, horizons growing; shape (n_lifted, p)."""
    few = replace(
        problem, segments=problem.segments.first(max(2, -(-options.pooled_segments // problem.segments.n_units)))
    )
    found: list[tuple[float, float, Array]] = []
    sigma = problem.sigma
    for first, balance in options.starts:
        grown = _grow(V, replace(few, sigma=_sigma(error, span, balance)), options, few.finite, first)
        if grown is None:
            continue
        end = minimise(few.evaluate, few.finite, grown, options.iterations, LEAST_GAIN)
        stable = _stabilise(end.V, few, options)
        if stable is not None and np.isfinite(end.cost).all():
            sigma = sigma if found else normalised(few, stable).sigma
            edged = replace(few, sigma=sigma, guard=GUARD)
            kept = minimise(edged.evaluate, edged.admissible, stable, _COMPARED, LEAST_GAIN)
            found.append((score(kept.V[0]), float(kept.cost[0]), kept.V))
            log.debug(
                "pooled model from horizon %d and balance %g: score %.6g, cost %.6g", first, balance, *found[-1][:2]
            )
    if not found:
        log.warning(
            "refinement of the pooled model: the best models are unstable, so it is sought among the stable ones"
        )
        grown = _grow(V, problem, options, problem.admissible, 1)
        if grown is None:
            raise IdentificationError(
                f"Refinement of the pooled model: free runs over {max(options.horizons)} samples diverge from every start; add shorter "
                "horizons, or leave out lifting functions that grow."
            )
        return np.asarray(grown[0])
    edged = replace(problem, sigma=sigma, guard=GUARD)
    best = min(found, key=lambda row: row[:2])[2]
    return np.asarray(minimise(edged.evaluate, edged.admissible, best, options.iterations, LEAST_GAIN).V[0])


def _grow(
    V: Array,
    problem: RefinementProblem,
    options: RefineOptions,
    admissible: Callable[[Array], npt.NDArray[np.bool_]],
    first: int,
) -> Array | None:
    """Minimise at growing horizons from the first one asked for, at most the longest; None where free runs diverge."""
    V = V.copy()
    V[:, problem.lifting.n_states :] = (
        problem.one_step.rows if admissible == problem.finite else V[:, problem.lifting.n_states :]
    )
    for horizon in (h for h in options.horizons if h >= min(first, options.horizons[-1])):
        now = problem.at(horizon)
        solution = minimise(now.evaluate, admissible, V, options.iterations, LEAST_GAIN)
        if not np.isfinite(solution.cost).all():
            return None
        V = solution.V
    return V


def normalised(problem: RefinementProblem, V: Array) -> RefinementProblem:
    """The problem with errors in units of those that a pooled model V leaves, and with a soft edge of stability."""
    normal = problem.run(V)
    size = np.sqrt(max(float(normal.cost.mean()) / problem.residuals, _LEAST_ERROR**2))
    return replace(problem, sigma=problem.sigma * size, guard=GUARD)


def _stabilise(V: Array, problem: RefinementProblem, options: RefineOptions) -> Array | None:
    """Bring a model from outside the edge of stability to the inside; None where that fails."""
    n = problem.lifting.n_states
    shortened = []
    for factor in np.linspace(1.0, 0.0, 21):
        shortened.append(V.copy())
        shortened[-1][:, n:] *= factor
    for margin in (max(GUARD, problem.margin), problem.margin):
        for trial in shortened:
            if replace(problem, margin=margin).admissible(trial).all():
                return trial
    V = min(shortened, key=lambda trial: _radius(trial, problem))
    weight = problem.residuals * problem.segments.n_units
    for heavier in 10.0 ** np.arange(_HEAVIER):

        def evaluate(trial: Array, share: float = heavier) -> Array:
            return problem.evaluate(trial) + share * stability_barrier(trial, problem.T, GUARD, weight)

        found = minimise(evaluate, problem.finite, V, options.iterations, LEAST_GAIN)
        if not np.isfinite(found.cost).all():
            return None
        V = found.V
        if problem.admissible(V).all():
            return V
    return None


def _radius(V: Array, problem: RefinementProblem) -> float:
    return float(np.abs(np.linalg.eigvals((V @ problem.T.T)[..., : problem.lifting.n_lifted])).max())


def restrict(problem: RefinementProblem, rows: npt.NDArray[np.int64]) -> RefinementProblem:
    """The problem of one model for some units."""
    own = {name: values[rows] for name, values in problem.parameters.items()}
    one_step = replace(problem.one_step, matrix=problem.one_step.matrix[rows], least=problem.one_step.least[rows])
    return replace(problem, parameters=own, segments=problem.segments.units(rows), one_step=one_step, pooled=True)


def ranges(factor: Factor, rows: npt.NDArray[np.int64], lifting: Lifting) -> tuple[Array, Array]:
    """Ranges of lifted states and inputs over the pooled units."""
    found = Ranges.of(factor, lifting.n_lifted, rows)
    return found.outputs, found.inputs


def matrices_of(V: Array, T: Array, n_lifted: int) -> KoopmanMatrices:
    """Return A and B of whitened parameters."""
    W = V @ T.T
    return KoopmanMatrices(W[..., :n_lifted], W[..., n_lifted:])


def _sigma(error: Array, span: Array, balance: float) -> Array:
    return np.asarray(error**balance * span ** (1 - balance))


def _whitening(R11: Array, n_samples: int) -> Array:
    """T with ``(R11 T)^T (R11 T) = n_samples I``; a direction that the data do not excite keeps its size."""
    size = np.maximum(np.linalg.norm(R11, axis=0), np.finfo(float).tiny)
    _, values, right = np.linalg.svd(R11 / size)
    values = np.maximum(values, len(values) * np.finfo(float).eps * values[0])
    return np.asarray((right.T / values) * np.sqrt(n_samples) / size[:, None])
