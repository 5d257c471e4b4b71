"""The pooled model: EDMD on all units together, then free-run error at growing horizons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...core.errors import IdentificationError
from ...core.linalg import qr_triangle
from ..edmd import KoopmanMatrices, edmd, smallest_stabilising_alpha
from .model import TrainingData
from .options import RefineOptions
from .problem import OneStep, RefinementProblem
from .segments import Segments

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


def refine_pooled(V: Array, problem: RefinementProblem, error: Array) -> Array:
    """Fit one model to all units, horizons growing, on some segments and at last on all; shape (n_lifted, p)."""
    options = problem.options
    count = max(2, -(-options.pooled_segments // problem.segments.n_units))
    few = replace(problem, segments=problem.segments.first(count), sigma=error**options.first_balance)
    for horizon in options.horizons:
        stage = few.at(horizon)
        V = options.search.minimise(stage.evaluate, stage.finite, V).V
    V = _stabilised(V, few)
    edged = normalised(replace(few, sigma=problem.sigma), V)
    edged = replace(problem, sigma=edged.sigma, edged=True)
    return np.asarray(options.search.minimise(edged.evaluate, edged.admissible, V).V[0])


def _stabilised(V: Array, problem: RefinementProblem) -> Array:
    """Bring a model inside the edge: by shorter rows of lifted functions, which free runs ignore, else by its penalty."""
    n, edged = problem.lifting.n_states, replace(problem, edged=True)
    if np.isfinite(problem.evaluate(V)).all():
        for share in np.linspace(1.0, 0.0, 21):
            trial = V.copy()
            trial[:, n:] *= share
            if problem.admissible(trial).all():
                return trial
        trial = problem.options.search.minimise(edged.evaluate, problem.finite, V).V
        if problem.admissible(trial).all():
            return trial
    raise IdentificationError(
        f"Refinement of the pooled model: free runs over {problem.options.horizons[-1]} samples diverge or the model "
        "is unstable; omit lifting functions that grow, or set identify.refine = false."
    )


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
