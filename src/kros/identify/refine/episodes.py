"""What each episode says about a finished refined model: normal equations of its cost, for resampling episodes without refitting.

    cost of a unit = sum over episodes of [ free runs of its segments + one-step error of the lifted functions ] + edge of stability + prior

The sum over episodes is what the search minimised, without its last two terms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError
from ...data.population import EpisodeKey, Population
from ...lifting import Lifting
from ..factors import Factor, combine
from .model import RefinedModels
from .options import SEED, RefineOptions
from .problem import _ROW_WEIGHT, OneStep, RefinementProblem
from .segments import Segments, held_segments, read_segments
from .sensitivity import normal_equations

Array = npt.NDArray[np.float64]
_AT_ONCE = 16_000_000  # numbers in memory


def segment_owners(keys: Mapping[str, Sequence[EpisodeKey]], count: int) -> npt.NDArray[np.int64]:
    """Return which episode of its unit each segment of `read_segments` comes from, shape (unit, segment)."""
    held = held_segments(count, keys)
    owners = np.empty((len(keys), count), dtype=np.int64)
    for row, episodes in enumerate(keys.values()):
        earlier = max(1, len(episodes) - 1)
        owners[row] = [*(i % earlier for i in range(count - held)), *[len(episodes) - 1] * held]
    return owners


def episode_normals(
    models: RefinedModels,
    population: Population,
    keys: Mapping[str, Sequence[EpisodeKey]],
    lifting: Lifting,
    parameters: Mapping[str, Array],
    factors: Factor,
    options: RefineOptions,
    pooled: npt.NDArray[np.bool_] | None = None,
) -> Array:
    """Return ``[J r]^T [J r]`` of every episode at the finished models, shape (unit, episode, P + 1, P + 1)."""
    n, nl, T = lifting.n_states, lifting.n_lifted, models.whitening
    units, most = len(keys), max(len(episodes) for episodes in keys.values())
    width = len(T) + nl
    if models.unit_ids != tuple(keys) or factors.R.shape != (units, most, width, width):
        raise DimensionError(
            f"Normal equations by episode: models of {len(models.unit_ids)} units and keys of {units} units with up to {most} episodes need factors of "
            f"shape {(units, most, width, width)}, found {factors.R.shape}; pass per-episode factors in the order of the models' units."
        )
    W = np.concatenate([models.units.A, models.units.B], axis=-1)
    V = np.swapaxes(np.linalg.solve(T, np.swapaxes(W, -1, -2)), -1, -2)
    segments = read_segments(population, keys, max(options.horizons), options.segments, SEED, lifting.history)
    whole = combine(factors)
    rows = np.arange(units) if pooled is None else np.flatnonzero(pooled)
    own = {name: np.asarray(parameters[name], dtype=float) for name in lifting.parameters}
    one_step = OneStep.of(whole.R, T, n, nl, whole.n_samples, rows)
    problem = RefinementProblem(lifting, own, segments, T, models.sigma, one_step, options.margin)
    total = np.zeros((units, most, V[0].size + 1, V[0].size + 1))
    runs, counts = _free_runs(V[:, :n], problem)
    owners = segment_owners(keys, options.segments)
    place = np.r_[0 : n * len(T), V[0].size]
    for row in range(units):
        np.add.at(total[row], (owners[row][:, None, None], place[:, None], place), runs[row])
    _add_one_step(total, V, factors, problem, counts / whole.n_samples)
    return total


def _free_runs(V: Array, problem: RefinementProblem) -> tuple[Array, Array]:
    """Normal equations of every segment's free run (unit, segment, n p + 1, n p + 1), and a unit's number of residuals of a state."""
    units, n, p = V.shape
    count, width = problem.segments.valid.shape[2], n * p + 1
    found, counts = np.empty((units, count, width, width)), np.empty(units)
    step = max(1, _AT_ONCE // (count * width * (width + n)))
    for rows in (np.arange(units)[start : start + step] for start in range(0, units, step)):
        alone = _one_by_one(problem.segments.units(rows))
        each = {name: np.repeat(values[rows], count) for name, values in problem.parameters.items()}
        normal = normal_equations(
            np.repeat(V[rows], count, axis=0), problem.T, problem.lifting, each, alone, problem.sigma, problem.stride
        )
        found[rows] = normal.matrix.reshape(len(rows), count, width, width)
        counts[rows] = normal.counts.reshape(len(rows), count).sum(axis=1)
    return found, counts


def _one_by_one(segments: Segments) -> Segments:
    """Every segment as a unit of its own."""
    states, inputs = (a.reshape(*a.shape[:2], -1, 1) for a in (segments.states, segments.inputs))
    return Segments(states, inputs, segments.valid.reshape(len(segments.valid), -1, 1), segments.history)


def _add_one_step(total: Array, V: Array, factors: Factor, problem: RefinementProblem, share: Array) -> None:
    """Add what each episode contributes to the rows of the lifted functions, weighted as in `RefinementProblem.evaluate`."""
    n, nl, p = problem.lifting.n_states, problem.lifting.n_lifted, len(problem.T)
    white = np.concatenate([factors.R[..., :p] @ problem.T, factors.R[..., p + n : p + nl]], axis=-1)
    by_episode = np.swapaxes(white, -1, -2) @ white  # [psi sigma+]^T [psi sigma+], (unit, episode, p + f, p + f)
    for row in range(n, nl):
        columns = np.r_[0:p, p + row - n]
        M = (
            by_episode[..., columns[:, None], columns]
            * (_ROW_WEIGHT * share / problem.one_step.variance[row - n])[:, None, None, None]
        )
        rest = np.concatenate([-V[:, row], np.ones((len(V), 1))], axis=1)  # r = [psi sigma+] rest
        pull = np.einsum("ueij,uj->uei", M, rest)
        place = slice(row * p, (row + 1) * p)
        total[..., place, place] += M[..., :p, :p]
        total[..., place, -1] += pull[..., :p]
        total[..., -1, place] += pull[..., :p]
        total[..., -1, -1] += np.einsum("uei,ui->ue", pull, rest)
