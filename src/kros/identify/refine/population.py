"""Refinement of a population: one pooled model on free-run error, then every unit with a prior centred on it.

    factors -> pooled EDMD -> pooled refined model -> units at each strength of the prior -> strength -> units

Models that predict alike may differ wildly in weakly excited directions, and what differs is uncertainty. The prior
therefore measures the distance from the pooled model as the uncertainty does (`metric`), and the strength is chosen on
held-out training episodes: the strongest one whose error is as good as the best, however unlike the models are then.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...core import EPS, TINY, Array, Flags, IdentificationError
from ...core.linalg import pieces, qr_triangle, radius_text
from ...data import EpisodeBatch, EpisodeKey, Population
from ...lifting import Lifting
from ..edmd import KoopmanMatrices, edmd, smallest_stabilising_alpha
from ..factors import Factor, Ranges
from ..free_run import free_run
from .metric import ResponsePrior
from .problem import OneStep, RefinementProblem, stability_barrier
from .search import RefineOptions
from .segments import Segments, TrainingData, held_segments, read_segments

log = logging.getLogger(__name__)


def refine_population(
    population: Population,
    keys: Mapping[str, Sequence[EpisodeKey]],
    lifting: Lifting,
    parameters: Mapping[str, Array],
    factor: Factor,
    pooled: Flags | None = None,
    options: RefineOptions | None = None,
) -> KoopmanMatrices:
    """Refine the models of a population on free-run error.

    Parameters
    ----------
    population : Population
    keys : mapping of str to sequence of EpisodeKey
        Training episodes of every unit; the last one of each validates the strength of the prior.
    lifting : Lifting
    parameters : mapping of str to ndarray, shape (unit,)
    factor : Factor
        Of ``[Psi | Theta_plus]`` for this lifting, the batch over units in the order of `keys`.
    pooled : ndarray of bool, shape (unit,), optional
        Units that make the pooled model and choose the strength; all by default. The others get the same prior.
    options : RefineOptions, optional

    Returns
    -------
    KoopmanMatrices
        Stable linear models with a bounded re-lifted free run on every training episode.

    Raises
    ------
    IdentificationError
        When no stable model is found, free runs diverge or leave their bound; names the unit where there is one.

    Examples
    --------
    >>> import kros
    >>> from kros.identify import unit_factors
    >>> from kros.identify.refine import GaussNewton, RefineOptions, refine_population
    >>> from kros.lifting import Lifting
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=3, seconds=1.0, seed=3).simulate().population
    >>> keys = {unit: motors.keys(unit) for unit in motors.unit_ids}
    >>> factor = unit_factors(motors, keys, Lifting(motors.states))
    >>> options = RefineOptions(horizons=(20,), segments=4, search=GaussNewton(iterations=3), path_iterations=3)
    >>> models = refine_population(motors, keys, Lifting(motors.states), {}, factor, options=options)
    >>> models.A.shape, bool(models.spectral_radius().max() < 1)
    ((2, 3, 3), True)
    """
    marks = np.ones(len(keys), dtype=bool) if pooled is None else np.asarray(pooled, dtype=bool)
    data = TrainingData(population, keys, lifting, parameters, factor, marks)
    ranges = Ranges.of(factor, lifting.n_lifted, marks)
    return ranges.restore(_refine(data.divided_by(ranges), options or RefineOptions()))


def _refine(data: TrainingData, options: RefineOptions) -> KoopmanMatrices:
    """Refine in channels divided by their ranges."""
    count, longest = options.segments, max(options.horizons)
    segments = read_segments(data.population, data.keys, longest, count, options.seed, data.lifting.history)
    start, problem = start_pooled(data, segments.first(count - held_segments(count, data.keys)), options)
    one_model = problem.of_one_model(data.rows)
    common = refine_pooled(start, one_model)
    pooled = problem.matrices(common)
    prior = ResponsePrior(pooled.A, pooled.B, problem.T, options.prior_level)
    problem = replace(problem, sigma=normalised(one_model, common[None]), edged=True, prior=prior)
    path, scores = _path(data, problem, common)
    best = float(np.min(scores))
    if not np.isfinite(best):
        raise IdentificationError("Refinement: a free run over held-out training data diverges; use stronger priors.")
    choice = int(np.argmax(scores <= (1 + options.tolerance) * best))  # the strongest prior about as good as the best
    strength = options.strengths[choice]
    log.info("prior of strength %g chosen, held-out score %.4g", strength, scores[choice])
    final = replace(problem, segments=segments).with_prior(strength)
    models = final.matrices(_fit(final, path[choice], options.final_iterations))
    for unit, radius in zip(data.keys, models.spectral_radius(), strict=True):
        if not radius < 1 - options.margin:
            raise IdentificationError(
                f"Refinement: the model of unit {unit} has spectral radius {radius_text(radius)}, not below "
                f"{radius_text(1 - options.margin)}; use a stronger prior."
            )
    require_bounded(data, models, options.bound)
    return models


def _path(data: TrainingData, problem: RefinementProblem, common: Array) -> tuple[list[Array], Array]:
    """Fit all units at falling strengths, until weaker ones bring nothing; return parameters and held-out errors."""
    options, path, scores = problem.options, list[Array](), list[float]()
    V = np.repeat(common[None], problem.segments.n_units, axis=0)
    for strength in options.strengths:
        V = _fit(problem.with_prior(strength), V, options.path_iterations)
        path.append(V)
        scores.append(_score(data, problem, V))
        earlier = scores[-1 - options.patience] if len(scores) > options.patience else np.inf
        if scores[-1] > (1 - options.tolerance / 2) * earlier:
            break
    return path, np.array(scores)


def _score(data: TrainingData, problem: RefinementProblem, V: Array) -> float:
    """Return the held-out error of pooled units."""
    pooled, last = data.rows.tolist(), [episodes[-1] for episodes in data.keys.values()]
    rms, _ = free_run_errors(data, problem.matrices(V[pooled]), pooled, [last[row] for row in pooled])
    return float(np.mean((rms / problem.sigma) ** 2))


def _fit(problem: RefinementProblem, V: Array, iterations: int) -> Array:
    """Fit every unit by itself; those that are done are not run on."""
    search = replace(problem.options.search, iterations=iterations)
    return search.minimise(problem.evaluate, problem.admissible, V, lambda rows: problem.of_units(rows).evaluate).V


def start_pooled(data: TrainingData, segments: Segments, options: RefineOptions) -> tuple[Array, RefinementProblem]:
    """Return pooled EDMD in whitened parameters (1, n_lifted, p), and the problem of all units."""
    lifting, rows = data.lifting, data.rows
    n, nl = lifting.n_states, lifting.n_lifted
    R = qr_triangle(data.factor.R[rows].reshape(-1, data.factor.R.shape[-1]))
    p = R.shape[-1] - nl
    matrices = edmd(R, nl, options.alpha_factor * smallest_stabilising_alpha([(R[None], nl)], options.margin))
    T = _whitening(R[:p, :p], int(data.factor.n_samples[rows].sum()))
    one_step = OneStep.of(data.factor, T, n, rows)
    problem = RefinementProblem(lifting, data.parameters, segments, T, np.ones(n), one_step, options)
    V = np.linalg.solve(T, np.concatenate([matrices.A, matrices.B], axis=-1).T).T[None]
    normal = problem.of_one_model(rows).run(V)
    with np.errstate(invalid="ignore"):
        error = np.sqrt(normal.squares.sum(axis=0) / normal.counts.sum())
    error = np.clip(np.where(np.isfinite(error), error, 1.0), options.least_error, 1.0)
    return V, replace(problem, sigma=error**options.balance)


def refine_pooled(V: Array, problem: RefinementProblem) -> Array:
    """Fit one model to all units, on some of the segments and then on all; shape (n_lifted, p)."""
    options = problem.options
    count = max(2, -(-options.pooled_segments // problem.segments.n_units))
    few = replace(problem, segments=problem.segments.first(count))
    inside = _stable_end(V, few)
    if inside is None:
        raise IdentificationError(
            f"Refinement of the pooled model: free runs over {options.horizons[-1]} samples diverge or the model is "
            "unstable; omit lifting functions that grow, or set identify.refine = false."
        )
    edged = replace(problem, sigma=normalised(few, inside), edged=True)
    return options.search.minimise(edged.evaluate, edged.admissible, inside).V[0]


def _stable_end(V: Array, problem: RefinementProblem) -> Array | None:
    """Minimise at growing horizons, then bring the model inside by a growing penalty; None where that fails."""
    options = problem.options
    for horizon in options.horizons:
        solution = options.search.minimise(problem.at(horizon).evaluate, problem.finite, V)
        if not np.isfinite(solution.cost).all():
            return None
        V = solution.V
    for heavier in 10.0 ** np.arange(options.penalties):
        if problem.admissible(V).all():
            return V

        def evaluate(trial: Array, weight: float = heavier * problem.edge_weight) -> Array:
            return problem.evaluate(trial) + stability_barrier(trial, problem.T, options.guard, weight)

        V = options.search.minimise(evaluate, problem.finite, V).V
    return V if problem.admissible(V).all() else None


def normalised(problem: RefinementProblem, V: Array) -> Array:
    """Return the sizes of errors with which those of a pooled model V are one on average."""
    mean_square = float(problem.run(V).cost.mean()) / problem.residuals
    return problem.sigma * max(np.sqrt(mean_square), problem.options.least_error)


def _whitening(R11: Array, n_samples: int) -> Array:
    """T with ``(R11 T)^T (R11 T) = n_samples I``; a direction that the data do not excite keeps its size."""
    size = np.maximum(np.linalg.norm(R11, axis=0), TINY)
    _, values, right = np.linalg.svd(R11 / size)
    values = np.maximum(values, len(values) * EPS * values[0])
    return (right.T / values) * np.sqrt(n_samples) / size[:, None]


_TOGETHER = 32  # episodes, as many as the compiled loop runs side by side


def free_run_errors(
    data: TrainingData, models: KoopmanMatrices, rows: Sequence[int], keys: Sequence[EpisodeKey]
) -> tuple[Array, Array]:
    """Return RMS errors of free runs over episodes of some rows of the data, and the largest values, both (episode, n).

    There is a model for every episode.
    """
    lifting, parameters = data.lifting, {name: given[rows] for name, given in data.parameters.items()}
    errors = []
    for part in pieces(len(keys), _TOGETHER):
        batch = EpisodeBatch.read(data.population, keys[part])
        values = {name: given[part] for name, given in parameters.items()}
        x, u = (np.ascontiguousarray(np.swapaxes(signal, 0, 1)) for signal in (batch.states, batch.inputs))
        runs = free_run(models.A[part], models.B[part], lifting, values, x[:, : lifting.history + 1], u)
        inside = batch.inside.T[..., None]
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.where(inside, (runs - x) ** 2, 0.0).sum(axis=1) / batch.lengths[:, None]
            errors.append((np.sqrt(squares), np.where(inside, np.abs(runs), 0.0).max(axis=1)))
    both = np.concatenate(errors, axis=1)
    both[~np.isfinite(both)] = np.inf
    return both[0], both[1]


def require_bounded(data: TrainingData, models: KoopmanMatrices, bound: float) -> None:
    """Refuse models whose free runs over a training episode leave the bound, in ranges of the states."""
    rows = [row for row, episodes in enumerate(data.keys.values()) for _ in episodes]
    keys = [key for episodes in data.keys.values() for key in episodes]
    _, reached = free_run_errors(data, models[rows], rows, keys)
    for which, state in np.argwhere(~(reached <= bound)):
        size = f"{reached[which, state]:.3g} times the range of {data.lifting.states[state]!r}, beyond {bound:g}"
        remedy = "use functions that stay bounded, drop the episode, or set identify.refine = false"
        raise IdentificationError(f"Refinement: the free run over {keys[which]} reaches {size}; {remedy}.")
