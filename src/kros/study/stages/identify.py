"""Stage: one pass over the training episodes to factors, then models of every kind in every condition."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from ...core.artifacts import save_artifact
from ...core.errors import DataError, IdentificationError
from ...core.linalg import radius_text
from ...data.population import EpisodeKey, Population
from ...identify import (
    Factor,
    KoopmanMatrices,
    ModelSet,
    Ranges,
    combine,
    edmd,
    lifted_factor,
    reduce_episode,
    residual_covariance,
    smallest_stabilising_alpha,
)
from ...identify.excitation import require_excitation, require_independent
from ...identify.refine import RefineOptions, refine_population
from ...identify.settings import IdentifySettings
from ...identify.spread import peak_residual_db
from ...lifting import Lifting
from ..engine.context import Context
from . import calibrate

log = logging.getLogger(__name__)
_DOUBLINGS = 12
_POINTS = 60  # frequencies at which the models of units are compared
Array = npt.NDArray[np.float64]
Task = tuple[Population, tuple[EpisodeKey, ...], Lifting]


def reduce_episodes(task: Task) -> Factor:
    """Reduce every episode of a task to its factor, stacked on the first axis."""
    population, keys, lifting = task
    factors = []
    for key in keys:
        try:
            factors.append(reduce_episode(*population.read_parts(key), lifting))
        except DataError as error:
            raise DataError(f"Identifying from {key}: {error}") from error
    return Factor.stack(factors)


def run(context: Context) -> None:
    """Reduce, identify, save."""
    facts, lifting = context.facts, context.lifting
    calibration = calibrate.load(context)
    known = [u for u in facts.groups if calibration is None or u in calibration.units]
    for condition in sorted({k.condition for k in facts.train}, key=lambda c: c != facts.identify_on):
        units = [u for u in known if facts.keys("train", u, condition)]
        tasks = [(context.population.select([u], [condition]), facts.keys("train", u, condition), lifting) for u in units]
        episodes = list(context.work.map(f"identify ({condition})", reduce_episodes, tasks))
        _save_factors(context, condition, units, episodes)
        whole = [combine(f) for f in episodes]
        factor = Factor.stack(whole)
        parameters = {} if calibration is None else {calibration.spec.parameter: np.array([calibration.units[u].phase_rad for u in units])}
        found = identify_models(context, condition, units, factor, parameters)
        if context.config.identify.refine and condition == facts.identify_on:
            found += refine_models(context, units, factor, parameters, found)
        longest = max(int(f.n_samples.max()) for f in episodes) * context.population.sample_period_s
        for models in (replace(m, longest_s=longest) for m in found):
            models.save(context.store.draft("models", context.model_folder(models.name, condition)))


def identify_models(context: Context, condition: str, units: list[str], factor: Factor, parameters: dict[str, Array]) -> list[ModelSet]:
    """Identify every kind of model of one condition with one common regularisation."""
    kinds = {name: context.lifting if name.startswith("koopman") else Lifting(context.lifting.states) for name in context.edmd_names}
    factors = {name: lifted_factor(factor, context.lifting, parameters, lifting) for name, lifting in kinds.items()}
    pooled = np.array([u in context.facts.pooled for u in units])
    config = context.config.identify
    rows = pooled if pooled.any() else slice(None)
    ranges = {name: Ranges.of(factors[name], kinds[name].n_lifted, rows) for name in kinds}
    alpha = config.alpha
    if alpha == "auto":
        shared = [(ranges[name].triangles(factors[name].R[rows]), kinds[name].n_lifted) for name in kinds]
        edge = smallest_stabilising_alpha(shared, config.margin)
        factor_of_edge = alpha_factor(shared, edge, config) if condition == context.facts.identify_on else config.alpha_factor
        alpha = factor_of_edge * edge
        told = "%s: alpha = %.4g for channels divided by their ranges, %g times the smallest that stabilises every model"
        log.info(told, condition, alpha, factor_of_edge)
    require_excitation(factor, context.population.inputs, units, condition, float(alpha))
    models = [
        fit(
            name,
            condition,
            kinds[name],
            context,
            units,
            factors[name],
            parameters if kinds[name].parameters else {},
            float(alpha),
            ranges[name],
        )
        for name in kinds
    ]
    if condition == context.facts.identify_on:
        for found in models:
            require_stable(found, pooled)
    return models


def alpha_factor(shared: list[tuple[Array, int]], edge: float, config: IdentifySettings) -> float:
    """Return how many times the smallest stabilising coefficient is taken: doubled until units are near enough for an uncertain set around one of them.

    Where no factor brings them near enough, the configured one stays.
    """
    limit = 20 * np.log10(config.largest_residual)
    for doubled in range(_DOUBLINGS if edge > 0 else 0):
        factor = config.alpha_factor * 2.0**doubled
        models = [edmd(R, n, factor * edge) for R, n in shared]
        if not any(peak_residual_db(m.A, m.B, np.ones(m.B.shape[1]), np.ones(m.B.shape[2]), _POINTS) > limit for m in models):
            return factor
    return config.alpha_factor


def refine_models(
    context: Context, units: list[str], factor: Factor, parameters: dict[str, Array], starts: list[ModelSet]
) -> list[ModelSet]:
    """Refine every kind of model on free-run error, the population first, then each unit with a prior centred on it.

    Beside the models, what the refinement found out (the pooled model, the trade-off, the information matrices) is written.
    """
    facts = context.facts
    keys = {u: facts.keys("train", u, facts.identify_on) for u in units}
    pooled = np.array([u in facts.pooled for u in units])
    options = refine_options(context.config.identify)
    work = [
        partial(
            refine_population,
            context.population,
            keys,
            start.lifting,
            start.parameters,
            lifted_factor(factor, context.lifting, parameters, start.lifting),
            pooled,
            options,
        )
        for start in starts
    ]
    refined = context.work.run("identify (refine)", work)
    models = [with_matrices(start, found.units, factor, context, parameters) for start, found in zip(starts, refined, strict=True)]
    for start, found in zip(models, refined, strict=True):
        found.save(context.store.draft("refinement", start.name))
    return models


def refine_options(config: IdentifySettings) -> RefineOptions:
    """Return the options of the refinement that a study asks for."""
    return RefineOptions(margin=max(config.margin, RefineOptions().margin), largest_residual=config.largest_residual)


def with_matrices(start: ModelSet, matrices: KoopmanMatrices, factor: Factor, context: Context, parameters: dict[str, Array]) -> ModelSet:
    """Return a refined model set with the names, scales and phases of the one it started from."""
    lifted = lifted_factor(factor, context.lifting, parameters, start.lifting)
    return replace(
        start,
        name=start.name.removesuffix("_edmd"),
        A=matrices.A,
        B=matrices.B,
        residual_covariance=residual_covariance(lifted.R, start.lifting.n_lifted, matrices, lifted.n_samples),
        alpha=None,
        alpha_in_ranges=False,
        status=("ok",) * len(start.unit_ids),
    )


def require_stable(models: ModelSet, pooled: npt.NDArray[np.bool_]) -> None:
    """Refuse unstable models where they feed the synthesis."""
    for unit, status, counts in zip(models.unit_ids, models.status, pooled, strict=True):
        if counts and status != "ok":
            raise IdentificationError(
                f"Identifying {models.name} of unit {unit} ({models.condition}) with alpha = {models.alpha:g}: the model is {status}; "
                "set identify.alpha = 'auto', or raise it."
            )


def fit(
    name: str,
    condition: str,
    lifting: Lifting,
    context: Context,
    units: list[str],
    factor: Factor,
    parameters: dict[str, Array],
    alpha: float,
    ranges: Ranges,
) -> ModelSet:
    """Fit the models of one kind in one condition; a regularisation that was searched acts on channels divided by their ranges."""
    if alpha == 0:
        require_independent(factor, lifting.names + context.population.inputs + lifting.input_functions, units, condition)
    config = context.config.identify
    nothing = np.zeros((len(units), 0, 0))
    unfitted = ModelSet(
        name=name,
        condition=condition,
        lifting=lifting,
        channels=context.population.channels,
        sample_period_s=context.population.sample_period_s,
        unit_ids=tuple(units),
        A=nothing,
        B=nothing,
        parameters=parameters,
        residual_covariance=nothing,
        output_scale=ranges.outputs,
        input_scale=ranges.inputs,
        alpha=alpha,
        alpha_in_ranges=config.alpha == "auto",
    )
    matrices = unfitted.fit(factor.R)
    radius = ranges.normalise(matrices).spectral_radius()
    return replace(
        unfitted,
        A=matrices.A,
        B=matrices.B,
        residual_covariance=residual_covariance(factor.R, lifting.n_lifted, matrices, factor.n_samples),
        status=tuple("ok" if r < 1 - config.margin else f"unstable, spectral radius {radius_text(r)}" for r in radius),
    )


def _save_factors(context: Context, condition: str, units: list[str], episodes: list[Factor]) -> None:
    from urllib.parse import quote

    folder = context.store.draft("factors", quote(condition, safe=""))
    keys = [[k.unit, k.episode] for u in units for k in context.facts.keys("train", u, condition)]
    arrays = {name: np.concatenate([getattr(f, name) for f in episodes]) for name in ("R", "peak", "n_samples")}
    content = {
        "condition": condition,
        "states": context.lifting.states,
        "functions": context.lifting.functions,
        "inputs": context.population.inputs,
        "input_functions": context.lifting.input_functions,
    }
    save_artifact(folder, "factors", {**content, "rows": keys}, arrays)
