"""Refinement of a population: one pooled model on free-run error, then every unit with a prior centred on it.

    factors -> pooled EDMD -> pooled refined model (horizons 5 .. 1000) -> units at each strength of the prior -> strength -> units

Models that predict alike may differ wildly in weakly excited directions, and what differs is uncertainty. The prior therefore measures
the distance from the pooled model as the uncertainty does (`metric`), and the strength is chosen on held-out training episodes: the
strongest one whose error is as good as the best.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError, IdentificationError
from ...core.linalg import radius_text
from ...data.population import EpisodeKey, Population
from ...data.prepare import scale_population
from ...lifting import Lifting
from ..factors import Factor
from ..ranges import Ranges
from .marquardt import Evaluate, Solution, minimise
from .metric import ResponsePrior
from .model import RefinedModels, TradeOff
from .options import GUARD, LARGEST_RESIDUAL, LEAST_GAIN, NEGLIGIBLE_RESIDUAL, SEED, TOLERANCE, RefineOptions
from .pooled import matrices_of, normalised, ranges, refine_pooled, restrict, start_pooled
from .problem import RefinementProblem
from .segments import held_segments, read_segments
from .validation_set import HeldOutRuns, find_unbounded

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
_ROUNDS = 4  # in which units that have not converged go on
_PATIENCE = 3  # strengths over which the score must improve


def refine_population(
    population: Population,
    keys: Mapping[str, Sequence[EpisodeKey]],
    lifting: Lifting,
    parameters: Mapping[str, Array],
    factor: Factor,
    pooled: npt.NDArray[np.bool_] | None = None,
    options: RefineOptions | None = None,
) -> RefinedModels:
    """Refine the models of a population on free-run error.

    Parameters
    ----------
    population : Population
    keys : mapping of str to sequence of EpisodeKey
        Training episodes of every unit; the last one of each validates the strength of the prior.
    lifting : Lifting
    parameters : mapping of str to ndarray, shape (unit,)
        The lifting's parameters, in the order of `keys`.
    factor : Factor
        Of ``[Psi | Theta_plus]`` for this lifting, the batch over units in the order of `keys` (see `lifted_factor`).
    pooled : ndarray of bool, shape (unit,), optional
        Units that make the pooled model and choose the strength; all by default. The others get the same prior.
    options : RefineOptions, optional

    Returns
    -------
    RefinedModels
        Stable linear models with a bounded re-lifted free run on every training episode.

    Raises
    ------
    IdentificationError
        When no stable start exists, free runs diverge or leave their bound; names the unit where there is one.
    DimensionError
        When keys, parameters and factors do not fit together.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> from kros.identify import combine, episode_factors
    >>> from kros.identify.refine import RefineOptions, refine_population
    >>> from kros.lifting import Lifting
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=3, seconds=1.0, seed=3).simulate().population
    >>> keys = {unit: motors.keys(unit) for unit in motors.unit_ids}
    >>> factor = combine(episode_factors(motors, keys, Lifting(motors.states)))
    >>> options = RefineOptions(horizons=(20,), segments=4, iterations=3, path_iterations=3)
    >>> refined = refine_population(motors, keys, Lifting(motors.states), {}, factor, options=options)
    >>> refined.units.A.shape, bool(refined.spectral_radius.max() < 1)
    ((2, 3, 3), True)
    """
    options = RefineOptions() if options is None else options
    pooled = np.ones(len(keys), dtype=bool) if pooled is None else np.asarray(pooled, dtype=bool)
    _check(population, keys, lifting, parameters, factor, pooled)
    values = {name: np.asarray(parameters[name], dtype=float) for name in lifting.parameters}
    span = Ranges.of(factor, lifting.n_lifted, pooled)
    sizes = span.sizes(lifting, population.inputs)
    found = _refine(
        scale_population(population, sizes), keys, lifting.in_sizes(sizes), values, span.factor(factor), pooled, options
    )
    return found.in_channels(span.inverse)


def _refine(
    population: Population,
    keys: Mapping[str, Sequence[EpisodeKey]],
    lifting: Lifting,
    parameters: Mapping[str, Array],
    factor: Factor,
    pooled: npt.NDArray[np.bool_],
    options: RefineOptions,
) -> RefinedModels:
    """Refine in channels divided by their ranges."""
    segments = read_segments(population, keys, max(options.horizons), options.segments, SEED, lifting.history)
    held = held_segments(options.segments, keys)
    fitted = segments.first(options.segments - held)
    rows = np.flatnonzero(pooled)
    start, problem, error, span = start_pooled(lifting, parameters, factor, fitted, rows, options)
    spans = ranges(factor, rows, lifting)
    validation = HeldOutRuns(population, keys, lifting, parameters, rows, problem, spans)
    common = refine_pooled(
        start, restrict(problem, rows), error, span, lambda V: validation.trade_off([V], (np.inf,))[0].score, options
    )
    prepared = _with_prior(problem, common, factor, rows)
    validation = replace(validation, problem=prepared)
    path, trade_off = _path(prepared, common, validation, options)
    choice = _choose(trade_off)
    log.info("prior of strength %g chosen, held-out score %.4g", trade_off[choice].strength, trade_off[choice].score)
    final = replace(prepared, segments=segments)
    solution = _settle(_strengthen(final, trade_off[choice].strength), path[choice], options)
    limit = options.bound * factor.peak[rows, : lifting.n_states].max(axis=0)

    def unbounded(V: Array, some: npt.NDArray[np.int64]) -> dict[int, str]:
        models = matrices_of(V, problem.T, lifting.n_lifted)
        own = {name: values[some] for name, values in parameters.items()}
        ids = tuple(keys)
        return find_unbounded(models.A, models.B, lifting, own, population, {ids[i]: keys[ids[i]] for i in some}, limit)

    solution, strengths = _keep_bounded(final, solution, common, trade_off[choice].strength, unbounded, options)
    units = matrices_of(solution.V, problem.T, lifting.n_lifted)
    radius = units.spectral_radius()
    _require_stable(tuple(keys), radius, options.margin)
    return RefinedModels(
        unit_ids=tuple(keys),
        units=units,
        pooled=matrices_of(common, problem.T, lifting.n_lifted),
        strength=trade_off[choice].strength,
        strengths=strengths,
        trade_off=(*validation.trade_off([common], (np.inf,)), *trade_off),
        sigma=prepared.sigma,
        converged=solution.converged,
        information=solution.matrix[:, :-1, :-1],
        whitening=problem.T,
        spectral_radius=radius,
    )


def _check(
    population: Population,
    keys: Mapping[str, Sequence[EpisodeKey]],
    lifting: Lifting,
    parameters: Mapping[str, Array],
    factor: Factor,
    pooled: npt.NDArray[np.bool_],
) -> None:
    m = len(population.inputs) + len(lifting.input_functions)
    width = 2 * lifting.n_lifted + m
    wrong = [
        name for name in lifting.parameters if name not in parameters or np.shape(parameters[name]) != (len(keys),)
    ]
    if factor.R.shape != (len(keys), width, width) or wrong or pooled.shape != (len(keys),) or not pooled.any():
        raise DimensionError(
            f"Refinement: {len(keys)} units with {lifting.n_lifted} lifted states and {m} inputs need factors of shape "
            f"{(len(keys), width, width)}, found {factor.R.shape}, parameters of one value a unit (wrong: {wrong}) and at least one pooled "
            f"unit, found {int(pooled.sum())} of {pooled.size}; pass factors from lifted_factor for the same units."
        )


def _with_prior(
    problem: RefinementProblem, common: Array, factor: Factor, rows: npt.NDArray[np.int64]
) -> RefinementProblem:
    """The problem of all units at the longest horizon, errors in units of those of the pooled model, with a prior around it."""
    edged = normalised(restrict(problem, rows), common[None])
    model = matrices_of(common, problem.T, problem.lifting.n_lifted)
    prior = ResponsePrior(model.A, model.B, problem.T, *ranges(factor, rows, problem.lifting))
    return replace(problem, sigma=edged.sigma, guard=GUARD, prior=prior)


def _strengthen(problem: RefinementProblem, strength: float) -> RefinementProblem:
    """Give the prior a strength, in proportion to the residuals that a unit's free runs have."""
    return (
        problem if problem.prior is None else replace(problem, prior=problem.prior.scaled(strength * problem.residuals))
    )


def _path(
    problem: RefinementProblem, common: Array, validation: HeldOutRuns, options: RefineOptions
) -> tuple[list[Array], list[TradeOff]]:
    """Fit all units at falling strengths, each from the one before, until weaker ones bring nothing or too much uncertainty."""
    V = np.repeat(common[None], problem.segments.n_units, axis=0)
    path: list[Array] = []
    rows: list[TradeOff] = []
    for strength in sorted(options.strengths, reverse=True):
        now = _strengthen(problem, strength)
        V = _fit(now, V, options.path_iterations).V
        path.append(V)
        rows += validation.trade_off([V], (strength,))
        log.debug(
            "prior of strength %g: held-out score %.4g, peak residual %.1f dB",
            strength,
            rows[-1].score,
            rows[-1].peak_db,
        )
        idle = len(rows) > _PATIENCE and rows[-1].score > (1 - TOLERANCE / 2) * rows[-1 - _PATIENCE].score
        if idle or _too_uncertain(rows[-1]):
            break
    return path, rows


def _fit(problem: RefinementProblem, V: Array, iterations: int) -> Solution:
    """Fit every unit by itself; those that are done are not run on."""

    def narrowed(rows: npt.NDArray[np.int64]) -> Evaluate:
        return replace(restrict(problem, rows), pooled=False, counted=problem.residuals).evaluate

    return minimise(problem.evaluate, problem.admissible, V, iterations, LEAST_GAIN, narrowed)


def _settle(problem: RefinementProblem, V: Array, options: RefineOptions) -> Solution:
    """Fit all units to the end: those that have not converged go on by themselves."""
    solution = _fit(problem, V, options.iterations)
    for _ in range(_ROUNDS):
        rows = np.flatnonzero(~solution.converged)
        if not rows.size:
            break
        part = replace(restrict(problem, rows), pooled=False)
        more = _fit(part, solution.V[rows], options.iterations)
        solution = solution.updated(rows, more)
    return solution


def _keep_bounded(
    problem: RefinementProblem,
    solution: Solution,
    common: Array,
    strength: float,
    unbounded: Callable[[Array, npt.NDArray[np.int64]], dict[int, str]],
    options: RefineOptions,
) -> tuple[Solution, Array]:
    """Fit units whose free runs leave their bound again, from the pooled model and with a prior ten times as strong, until none does."""
    rows = np.arange(len(solution.V))
    strengths = np.full(len(rows), strength)
    for _ in range(_ROUNDS):
        found = unbounded(solution.V[rows], rows)
        if not found:
            return solution, strengths
        rows, strength = rows[sorted(found)], 10 * strength
        strengths[rows] = strength
        log.warning(
            "%s; fitted again with a prior of strength %g", "; ".join(found[i] for i in sorted(found)), strength
        )
        part = replace(restrict(_strengthen(problem, strength), rows), pooled=False)
        V = np.repeat(common[None], len(rows), axis=0)
        solution = solution.updated(rows, _fit(part, V, options.iterations))
    raise IdentificationError(
        f"Refinement: {next(iter(found.values()))}, even with a prior of strength {strength:g}; use longer horizons, or functions that stay bounded."
    )


def _too_uncertain(row: TradeOff) -> bool:
    return row.peak_db > 20 * np.log10(LARGEST_RESIDUAL)


def _choose(rows: Sequence[TradeOff]) -> int:
    """The strongest prior whose held-out score is as good as the best, within the tolerance, or a weaker and better one that costs nothing.

    Uncertainty costs nothing while the peak residual is negligible. Only the last of the rows may be too uncertain.
    """
    usable = [row for row in rows if not _too_uncertain(row)] or list(rows)
    best = min(row.score for row in usable)
    if not np.isfinite(best):
        raise IdentificationError(
            "Refinement: at every strength of the prior a free run over a held-out training episode diverges; add strengths above "
            f"{max(row.strength for row in rows):g}."
        )
    choice = next(i for i, row in enumerate(rows) if row.score <= (1 + TOLERANCE) * best)
    negligible = 20 * np.log10(NEGLIGIBLE_RESIDUAL)
    free = [i for i, row in enumerate(rows) if i >= choice and row.peak_db <= negligible]
    return min(free, key=lambda i: rows[i].score, default=choice)


def _require_stable(unit_ids: Sequence[str], radius: Array, margin: float) -> None:
    for unit, value in zip(unit_ids, radius, strict=True):
        if not value < 1 - margin:
            raise IdentificationError(
                f"Refinement: the model of unit {unit} has spectral radius {radius_text(value)}, not below {radius_text(1 - margin)}; use a stronger prior."
            )
