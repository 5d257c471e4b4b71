"""The pooled model: EDMD on all units together, then free-run error at growing horizons, from several starts."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...core.errors import IdentificationError
from ...core.linalg import qr_triangle
from ..edmd import KoopmanMatrices, edmd, smallest_stabilising_alpha
from .model import TrainingData
from .options import RefineOptions
from .problem import OneStep, RefinementProblem, stability_barrier
from .segments import Segments

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]


def start_pooled(
    data: TrainingData, segments: Segments, options: RefineOptions
) -> tuple[Array, RefinementProblem, Array]:
    """Return pooled EDMD in whitened parameters (1, n_lifted, p), the problem of all units, and errors of states."""
    lifting, rows = data.lifting, data.rows
    n, nl = lifting.n_states, lifting.n_lifted
    R = qr_triangle(data.factor.R[rows].reshape(-1, data.factor.R.shape[-1]))
    p = R.shape[-1] - nl
    matrices = edmd(R, nl, options.alpha_factor * smallest_stabilising_alpha([(R[None], nl)], options.margin))
    T = _whitening(R[:p, :p], int(data.factor.n_samples[rows].sum()))
    V = np.linalg.solve(T, np.concatenate([matrices.A, matrices.B], axis=-1).T).T[None]
    one_step = OneStep.of(data.factor, T, n, rows)
    problem = RefinementProblem(lifting, data.parameters, segments, T, np.ones(n), one_step, options)
    normal = problem.of_one_model(rows).run(V)
    with np.errstate(invalid="ignore"):
        error = np.sqrt(normal.squares.sum(axis=0) / normal.counts.sum())
    error = np.clip(np.where(np.isfinite(error), error, 1.0), options.least_error, 1.0)
    return V, replace(problem, sigma=error**options.balance), error


def refine_pooled(V: Array, problem: RefinementProblem, error: Array, score: Callable[[Array], float]) -> Array:
    """Fit one model to all units, horizons growing, from every start; shape (n_lifted, p)."""
    options = problem.options
    count = max(2, -(-options.pooled_segments // problem.segments.n_units))
    few = replace(problem, segments=problem.segments.first(count))
    briefly = replace(options.search, iterations=options.trial_iterations)
    ends: list[tuple[float, float, Array]] = []
    sigma = problem.sigma
    for first, balance in options.starts:
        inside = _stable_end(V, few, error**balance, first)
        if inside is not None:
            sigma = sigma if ends else normalised(few, inside).sigma
            edged = replace(few, sigma=sigma, edged=True)
            end = briefly.minimise(edged.evaluate, edged.admissible, inside)
            ends.append((score(end.V[0]), float(end.cost[0]), end.V))
            log.debug(
                "pooled model from horizon %d and balance %g: score %.6g, cost %.6g", first, balance, *ends[-1][:2]
            )
    if not ends:
        raise IdentificationError(
            f"Refinement of the pooled model: from every start free runs over {options.horizons[-1]} samples diverge "
            "or the model is unstable; leave out lifting functions that grow, or set identify.refine = false."
        )
    edged = replace(problem, sigma=sigma, edged=True)
    best = min(ends, key=lambda row: row[:2])[2]
    return np.asarray(options.search.minimise(edged.evaluate, edged.admissible, best).V[0])


def _stable_end(V: Array, problem: RefinementProblem, sigma: Array, first: int) -> Array | None:
    """Minimise at growing horizons, then bring the model inside the edge of stability; None where that fails."""
    options = problem.options
    stages = [replace(problem, sigma=sigma).at(h) for h in options.horizons if h >= min(first, options.horizons[-1])]
    for stage in (*stages, problem):
        solution = options.search.minimise(stage.evaluate, problem.finite, V)
        if not np.isfinite(solution.cost).all():
            return None
        V = solution.V
    return _stabilise(V, problem)


def _stabilise(V: Array, problem: RefinementProblem) -> Array | None:
    """Bring a model inside: by shorter rows of lifted functions, which free runs ignore, else by a growing penalty."""
    n, options = problem.lifting.n_states, problem.options
    shortened = []
    for share in np.linspace(1.0, 0.0, options.shortenings + 1):
        shortened.append(V.copy())
        shortened[-1][:, n:] *= share
    for margin in (max(options.guard, options.margin), options.margin):
        for trial in shortened:
            if problem.admissible(trial, margin).all():
                return trial
    V = min(shortened, key=lambda trial: float(matrices_of(trial, problem).spectral_radius().max()))
    for heavier in 10.0 ** np.arange(options.penalties):

        def evaluate(trial: Array, weight: float = heavier) -> Array:
            edge = stability_barrier(trial, problem.T, options.guard, problem.edge_weight)
            return problem.evaluate(trial) + weight * edge

        solution = options.search.minimise(evaluate, problem.finite, V)
        if not np.isfinite(solution.cost).all():
            return None
        V = solution.V
        if problem.admissible(V).all():
            return V
    return None


def normalised(problem: RefinementProblem, V: Array) -> RefinementProblem:
    """Return the problem with errors in units of those of a pooled model V, and with a soft edge of stability."""
    normal, least = problem.run(V), problem.options.least_error
    size = np.sqrt(max(float(normal.cost.mean()) / problem.residuals, least**2))
    return replace(problem, sigma=problem.sigma * size, edged=True)


def matrices_of(V: Array, problem: RefinementProblem) -> KoopmanMatrices:
    """Return A and B of whitened parameters."""
    W, n_lifted = V @ problem.T.T, problem.lifting.n_lifted
    return KoopmanMatrices(W[..., :n_lifted], W[..., n_lifted:])


def _whitening(R11: Array, n_samples: int) -> Array:
    """T with ``(R11 T)^T (R11 T) = n_samples I``; a direction that the data do not excite keeps its size."""
    size = np.maximum(np.linalg.norm(R11, axis=0), np.finfo(float).tiny)
    _, values, right = np.linalg.svd(R11 / size)
    values = np.maximum(values, len(values) * np.finfo(float).eps * values[0])
    return np.asarray((right.T / values) * np.sqrt(n_samples) / size[:, None])
