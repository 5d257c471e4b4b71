"""Refinement of a population: one pooled model on free-run error, then every unit with a prior centred on it.

    factors -> pooled EDMD -> pooled refined model (horizons 5 .. 1000) -> units at each strength of the prior -> strength -> units

Models that predict alike may differ wildly in weakly excited directions, and what differs is uncertainty. The prior therefore measures
the distance from the pooled model as the uncertainty does (`metric`), and the strength is chosen on held-out training episodes: the
strongest one whose error is as good as the best.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError, IdentificationError
from ...core.linalg import qr_triangle
from ...data.population import EpisodeKey, Population
from ...lifting import Lifting
from ..edmd import KoopmanMatrices, edmd, smallest_stabilising_alpha
from ..factors import Factor
from .judge import free_run_errors, require_bounded
from .marquardt import Solution, minimise
from .metric import ResponsePrior
from .model import RefinedModels, TradeOff
from .options import RefineOptions
from .problem import OneStep, Problem
from .segments import Segments, held_segments, read_segments

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
_LEAST_ERROR = 1e-6  # of the start, relative to a state's range: exact data have no error to scale by


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
        Training episodes of every unit; the last one of each judges the strength of the prior.
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
    """
    options = RefineOptions() if options is None else options
    pooled = np.ones(len(keys), dtype=bool) if pooled is None else np.asarray(pooled, dtype=bool)
    _check(population, keys, lifting, parameters, factor, pooled)
    parameters = {name: np.asarray(parameters[name], dtype=float) for name in lifting.parameters}
    segments = read_segments(population, keys, max(options.horizons), options.segments, options.seed)
    held = held_segments(options.segments, keys)
    fitted = segments.first(options.segments - held)
    rows = np.flatnonzero(pooled)
    start, problem, error, span = _start(lifting, parameters, factor, fitted, rows, options)
    common = _refine_pooled(start, _restrict(problem, rows), error, span, options)
    prepared = _with_prior(problem, common, factor, rows, options)
    path = _path(prepared, common, options)
    judged = _Judge(population, keys, lifting, parameters, rows, prepared, _scales(factor, rows, lifting))
    trade_off = judged.trade_off([common, *path], (np.inf, *sorted(options.strengths, reverse=True)))
    choice = _choose(trade_off[1:], options.tolerance)
    strength = trade_off[1 + choice].strength
    log.info("prior of strength %g chosen, held-out score %.4g", strength, trade_off[1 + choice].score)
    final = _strengthen(replace(prepared, segments=segments), strength)
    solution = minimise(final.evaluate, final.admissible, path[choice], options.iterations, options.least_gain)
    units = _matrices(solution.V, problem.T, lifting.n_lifted)
    limit = options.bound * factor.peak[rows, : lifting.n_states].max(axis=0)
    require_bounded(units.A, units.B, lifting, parameters, population, keys, limit)
    return RefinedModels(
        unit_ids=tuple(keys),
        units=units,
        pooled=_matrices(common, problem.T, lifting.n_lifted),
        strength=strength,
        trade_off=trade_off,
        sigma=prepared.sigma,
        status=_status(solution, units, options.margin),
        information=solution.matrix[:, :-1, :-1],
        whitening=problem.T,
        spectral_radius=units.spectral_radius(),
    )


def _check(
    population: Population,
    keys: Mapping[str, Sequence[EpisodeKey]],
    lifting: Lifting,
    parameters: Mapping[str, Array],
    factor: Factor,
    pooled: npt.NDArray[np.bool_],
) -> None:
    width = 2 * lifting.n_lifted + len(population.inputs)
    wrong = [name for name in lifting.parameters if name not in parameters or np.shape(parameters[name]) != (len(keys),)]
    if factor.R.shape != (len(keys), width, width) or wrong or pooled.shape != (len(keys),) or not pooled.any():
        raise DimensionError(
            f"Refinement: {len(keys)} units with {lifting.n_lifted} lifted states and {len(population.inputs)} inputs need factors of shape "
            f"{(len(keys), width, width)}, found {factor.R.shape}, parameters of one value a unit (wrong: {wrong}) and at least one pooled "
            f"unit, found {int(pooled.sum())} of {pooled.size}; pass factors from lifted_factor for the same units."
        )


def _scales(factor: Factor, rows: npt.NDArray[np.int64], lifting: Lifting) -> tuple[Array, Array]:
    """Ranges of lifted states and inputs over the pooled units."""
    peak = factor.peak[rows].max(axis=0)
    peak = np.where(peak > 0, peak, 1.0)
    return peak[: lifting.n_lifted], peak[lifting.n_lifted :]


def _start(
    lifting: Lifting,
    parameters: Mapping[str, Array],
    factor: Factor,
    segments: Segments,
    rows: npt.NDArray[np.int64],
    options: RefineOptions,
) -> tuple[Array, Problem, Array, Array]:
    """Pooled EDMD in whitened parameters (1, n_lifted, p), the problem of all units without a prior, errors and ranges of states."""
    nl, n = lifting.n_lifted, lifting.n_states
    R = qr_triangle(factor.R[rows].reshape(-1, factor.R.shape[-1]))
    p = R.shape[-1] - nl
    alpha = options.alpha_factor * smallest_stabilising_alpha([(R[None], nl)], options.margin)
    matrices = edmd(R, nl, alpha)
    T = _whitening(R[:p, :p], int(factor.n_samples[rows].sum()))
    V = np.linalg.solve(T, np.concatenate([matrices.A, matrices.B], axis=-1).T).T[None]
    one_step = OneStep.of(factor.R, T, n, nl, factor.n_samples, rows)
    problem = Problem(lifting, parameters, segments, T, np.ones(n), one_step, options.margin)
    normal = _restrict(problem, rows).run(V)
    with np.errstate(invalid="ignore"):
        error = np.sqrt(normal.squares.sum(axis=0) / normal.counts.sum())
    span = _scales(factor, rows, lifting)[0][:n]
    error = np.clip(np.where(np.isfinite(error), error, span), _LEAST_ERROR * span, span)
    return V, replace(problem, sigma=_sigma(error, span, options.balance)), error, span


def _sigma(error: Array, span: Array, balance: float) -> Array:
    return np.asarray(error**balance * span ** (1 - balance))


def _whitening(R11: Array, n_samples: int) -> Array:
    """T with ``(R11 T)^T (R11 T) = n_samples I``; a direction that the data do not excite keeps its size."""
    size = np.maximum(np.linalg.norm(R11, axis=0), np.finfo(float).tiny)
    _, values, right = np.linalg.svd(R11 / size)
    values = np.maximum(values, len(values) * np.finfo(float).eps * values[0])
    return np.asarray((right.T / values) * np.sqrt(n_samples) / size[:, None])


def _restrict(problem: Problem, rows: npt.NDArray[np.int64]) -> Problem:
    """The problem of one model for some units."""
    own = {name: values[rows] for name, values in problem.parameters.items()}
    one_step = replace(problem.one_step, matrix=problem.one_step.matrix[rows], least=problem.one_step.least[rows])
    return replace(problem, parameters=own, segments=problem.segments.units(rows), one_step=one_step, pooled=True)


def _refine_pooled(V: Array, problem: Problem, error: Array, span: Array, options: RefineOptions) -> Array:
    """Fit one model to all units, horizons growing; shape (n_lifted, p).

    The free-run error has several minima, so the search is made once for every way of weighing the states in `options.starts`, and
    the ends are finished and compared in the weighing asked for. On the way a model may be unstable: kept stable from the start, the
    search runs into the edge of stability and stops there, far from the optimum.
    """
    few = replace(problem, segments=problem.segments.first(max(2, -(-options.pooled_segments // problem.segments.n_units))))
    found: list[tuple[float, Array, Array]] = []
    for balance in options.starts:
        grown = _grow(V, replace(few, sigma=_sigma(error, span, balance)), options, few.finite)
        if grown is None:
            continue
        end = minimise(few.evaluate, few.finite, grown, options.iterations, options.least_gain)
        stable = _shorten(end.V, problem, options.guard)
        if stable is not None and np.isfinite(end.cost).all():
            edged = _normalised(problem, stable, options) if not found else replace(problem, sigma=found[0][2], guard=options.guard)
            final = minimise(edged.evaluate, edged.admissible, stable, options.iterations, options.least_gain)
            found.append((float(final.cost[0]), final.V[0], edged.sigma))
            log.debug("pooled model from balance %g: cost %.6g", balance, final.cost[0])
    if not found:
        log.warning("refinement of the pooled model: the best models are unstable, so it is sought among the stable ones")
        grown = _grow(V, problem, options, problem.admissible)
        if grown is None:
            raise IdentificationError(
                f"Refinement of the pooled model: free runs over {max(options.horizons)} samples diverge from every start; add shorter "
                "horizons, or leave out lifting functions that grow."
            )
        return np.asarray(grown[0])
    return min(found, key=lambda pair: pair[0])[1]


def _grow(V: Array, problem: Problem, options: RefineOptions, admissible: Callable[[Array], npt.NDArray[np.bool_]]) -> Array | None:
    """Minimise at growing horizons; None where free runs diverge."""
    V = V.copy()
    V[:, problem.lifting.n_states :] = problem.one_step.rows if admissible == problem.finite else V[:, problem.lifting.n_states :]
    for horizon in options.horizons:
        now = problem.at(horizon)
        solution = minimise(now.evaluate, admissible, V, options.iterations, options.least_gain)
        if not np.isfinite(solution.cost).all():
            return None
        V = solution.V
    return V


def _normalised(problem: Problem, V: Array, options: RefineOptions) -> Problem:
    """The problem with errors in units of those that a pooled model V leaves, and with a soft edge of stability."""
    normal = problem.run(V)
    size = np.sqrt(max(float(normal.cost.mean()) / problem.residuals, _LEAST_ERROR**2))
    return replace(problem, sigma=problem.sigma * size, guard=options.guard)


def _shorten(V: Array, problem: Problem, guard: float) -> Array | None:
    """Scale the rows of lifted functions by the largest of a few factors that makes the model stable, off the edge where it can be."""
    n = problem.lifting.n_states
    for margin in (max(guard, problem.margin), problem.margin):
        for factor in np.linspace(1.0, 0.0, 21):
            trial = V.copy()
            trial[:, n:] *= factor
            if replace(problem, margin=margin).admissible(trial).all():
                return trial
    return None


def _with_prior(problem: Problem, common: Array, factor: Factor, rows: npt.NDArray[np.int64], options: RefineOptions) -> Problem:
    """The problem of all units at the longest horizon, errors in units of those of the pooled model, with a prior around it."""
    edged = _normalised(_restrict(problem, rows), common[None], options)
    model = _matrices(common, problem.T, problem.lifting.n_lifted)
    prior = ResponsePrior(model.A, model.B, problem.T, *_scales(factor, rows, problem.lifting), level=options.level, power=options.power)
    return replace(problem, sigma=edged.sigma, guard=options.guard, prior=prior)


def _strengthen(problem: Problem, strength: float) -> Problem:
    """Give the prior a strength, in proportion to the residuals that a unit's free runs have."""
    return problem if problem.prior is None else replace(problem, prior=problem.prior.scaled(strength * problem.residuals))


def _path(problem: Problem, common: Array, options: RefineOptions) -> Array:
    """Fit all units at every strength, strongest first, each from the one before; shape (strength, unit, n_lifted, p)."""
    V = np.repeat(common[None], problem.segments.n_units, axis=0)
    path = []
    for strength in sorted(options.strengths, reverse=True):
        now = _strengthen(problem, strength)
        V = minimise(now.evaluate, now.admissible, V, options.path_iterations, options.least_gain).V
        path.append(V)
    return np.stack(path)


def _matrices(V: Array, T: Array, n_lifted: int) -> KoopmanMatrices:
    W = V @ T.T
    return KoopmanMatrices(W[..., :n_lifted], W[..., n_lifted:])


@dataclass(frozen=True, eq=False)
class _Judge:
    """Scores models on the last training episode of every pooled unit."""

    population: Population
    keys: Mapping[str, Sequence[EpisodeKey]]
    lifting: Lifting
    parameters: Mapping[str, Array]
    rows: npt.NDArray[np.int64]
    problem: Problem
    scales: tuple[Array, Array]

    def trade_off(self, V: Sequence[Array], strengths: Sequence[float]) -> tuple[TradeOff, ...]:
        """Return accuracy and uncertainty of models (unit, n_lifted, p), or of one for all units."""
        full = np.stack([np.broadcast_to(v, (len(self.keys), *v.shape[-2:]))[self.rows] for v in V])
        models = _matrices(full, self.problem.T, self.lifting.n_lifted)
        last = [episodes[-1] for episodes in self.keys.values()]
        own = {name: values[self.rows] for name, values in self.parameters.items()}
        rms, top, _ = free_run_errors(models.A, models.B, self.lifting, own, self.population, [last[row] for row in self.rows])
        percent = np.median(100 * rms / np.maximum(top, np.finfo(float).tiny), axis=1)
        score = np.mean((rms / self.problem.sigma) ** 2, axis=(1, 2))
        return tuple(
            TradeOff(float(s), tuple(percent[i].tolist()), float(score[i]), self._peak_db(models.A[i], models.B[i]))
            for i, s in enumerate(strengths)
        )

    def _peak_db(self, A: Array, B: Array) -> float:
        """Peak residual for the best nominal; the identical models of the pooled row have none."""
        if len(A) < 2:
            return float("nan")
        output, entry = self.scales
        z = np.exp(1j * np.pi * np.logspace(-6, 0, 200))
        G = np.linalg.solve(z[:, None, None] * np.eye(A.shape[-1]) - A[:, None], B[:, None] + 0j) * entry / output[:, None]
        inverse = np.linalg.pinv(G)
        peaks = [np.linalg.norm(inverse @ (G[row] - G), ord=2, axis=(-2, -1)).max() for row in range(len(G))]
        with np.errstate(divide="ignore"):
            return float(20 * np.log10(min(peaks)))


def _choose(rows: Sequence[TradeOff], tolerance: float) -> int:
    """The strongest prior whose held-out score is as good as the best, within the tolerance."""
    best = min(row.score for row in rows)
    if not np.isfinite(best):
        raise IdentificationError(
            "Refinement: at every strength of the prior a free run over a held-out training episode diverges; add strengths above "
            f"{max(row.strength for row in rows):g}."
        )
    return next(i for i, row in enumerate(rows) if row.score <= (1 + tolerance) * best)


def _status(solution: Solution, units: KoopmanMatrices, margin: float) -> tuple[str, ...]:
    radius = units.spectral_radius()
    return tuple(
        f"unstable, spectral radius {r:.6f}" if r >= 1 - margin else "ok" if done else "ok, not converged"
        for r, done in zip(radius, solution.converged, strict=True)
    )
