"""Normal equations of every episode at finished refined models, for resampling episodes without refitting.

    cost of a unit = sum over episodes of [ free runs of its segments + one-step error of the lifted functions ]
                     + edge of stability + prior

The sum over episodes is what the search minimised, without its last two terms.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..edmd import KoopmanMatrices
from ..factors import Factor, combine
from .model import Refinement, TrainingData
from .problem import OneStep, RefinementProblem
from .search import RefineOptions
from .segments import read_segments, segment_owners
from .sensitivity import normal_equations

Array = npt.NDArray[np.float64]


def episode_normals(
    models: KoopmanMatrices, refinement: Refinement, data: TrainingData, options: RefineOptions
) -> Array:
    """Return ``[J r]^T [J r]`` of every episode, shape (unit, episode, P + 1, P + 1), from factors (unit, episode)."""
    lifting, T, keys = data.lifting, refinement.whitening, data.keys
    n, units, most = lifting.n_states, len(keys), max(len(episodes) for episodes in keys.values())
    data.require_factors((units, most))
    W = np.concatenate([models.A, models.B], axis=-1)
    V = np.swapaxes(np.linalg.solve(T, np.swapaxes(W, -1, -2)), -1, -2)
    longest, count = max(options.horizons), options.segments
    segments = read_segments(data.population, keys, longest, count, options.seed, lifting.history)
    whole = combine(data.factor)
    one_step = OneStep.of(whole, T, n, data.rows)
    problem = RefinementProblem(lifting, data.parameters, segments, T, refinement.sigma, one_step, options)
    total = np.zeros((units, most, V[0].size + 1, V[0].size + 1))
    runs, counts = _free_runs(V[:, :n], problem)
    owners = segment_owners(keys, count)
    place = np.r_[0 : n * len(T), V[0].size]
    for row in range(units):
        np.add.at(total[row], (owners[row][:, None, None], place[:, None], place), runs[row])
    _add_one_step(total, V, data.factor, problem, counts / whole.n_samples)
    return total


def _free_runs(V: Array, problem: RefinementProblem) -> tuple[Array, Array]:
    """Normal equations of every segment (unit, segment, n p + 1, n p + 1), and a unit's residuals of a state."""
    units, n, p = V.shape
    count, width = problem.segments.valid.shape[2], n * p + 1
    runs, counts = np.empty((units, count, width, width)), np.empty(units)
    for row in range(units):
        values = {name: np.repeat(given[[row]], count) for name, given in problem.parameters.items()}
        alone, each = problem.segments.units(np.array([row])).one_by_one(), np.repeat(V[[row]], count, axis=0)
        normal = normal_equations(each, problem.T, problem.lifting, values, alone, problem.sigma, problem.stride)
        runs[row], counts[row] = normal.matrix, normal.counts.sum()
    return runs, counts


def _add_one_step(total: Array, V: Array, factors: Factor, problem: RefinementProblem, share: Array) -> None:
    """Add what each episode contributes to the rows of lifted functions, as in `RefinementProblem.evaluate`."""
    n, nl, p = problem.lifting.n_states, problem.lifting.n_lifted, len(problem.T)
    white = np.concatenate([factors.R[..., :p] @ problem.T, factors.R[..., p + n : p + nl]], axis=-1)
    by_episode = np.swapaxes(white, -1, -2) @ white  # [psi sigma+]^T [psi sigma+], (unit, episode, p + f, p + f)
    for row in range(n, nl):
        columns = np.r_[0:p, p + row - n]
        weight = problem.options.row_weight * share / problem.one_step.variance[row - n]
        M = by_episode[..., columns[:, None], columns] * weight[:, None, None, None]
        rest = np.concatenate([-V[:, row], np.ones((len(V), 1))], axis=1)  # r = [psi sigma+] rest
        pull = np.einsum("ueij,uj->uei", M, rest)
        place = slice(row * p, (row + 1) * p)
        total[..., place, place] += M[..., :p, :p]
        total[..., place, -1] += pull[..., :p]
        total[..., -1, place] += pull[..., :p]
        total[..., -1, -1] += np.einsum("uei,ui->ue", pull, rest)
