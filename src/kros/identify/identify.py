"""The verb: from a population's recordings to models of every unit.

recordings --survey--> training episodes --calibrate--> parameters of the lifting
training episodes --one pass--> factors --EDMD, one regularisation for all--> koopman_edmd, linear_edmd in every condition
in the condition that feeds synthesis --refined on free-run error--> koopman, linear
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, IdentificationError
from ..core.linalg import radius_text
from ..core.settings import require_kind
from ..core.work import Work
from ..data.population import EpisodeKey, Population
from ..data.prepare import mark_of
from ..data.survey import RecordingFacts, check_usable, survey
from ..lifting import Lifting
from .calibrate import calibrate
from .calibration import PhaseCalibration
from .edmd import KoopmanMatrices, edmd, residual_covariance, smallest_stabilising_alpha
from .excitation import require_excitation, require_independent
from .factors import Factor, combine, lifted_factor, reduce_episode
from .identified import EpisodeFactors, IdentifiedModels
from .kinds import kinds_for
from .model_set import ModelSet
from .presets import lifting_settings, resolve_lifting, resolve_phase
from .ranges import Ranges
from .refine import RefinedModels, refine_population
from .refine.options import LARGEST_RESIDUAL
from .refine.spread import peak_residual_db
from .settings import CalibrationSettings, IdentifySettings, LiftingSettings

log = logging.getLogger(__name__)
_DOUBLINGS = 12
_POINTS = 60  # frequencies at which the models of units are compared
Array = npt.NDArray[np.float64]
Task = tuple[Population, tuple[EpisodeKey, ...], Lifting]
Refining = Callable[[], tuple[list[ModelSet], dict[str, RefinedModels]]]


def identify(
    population: Population,
    lifting: Lifting | LiftingSettings | Mapping[str, Any] | Sequence[str] | None = None,
    *,
    identify_on: str | None = None,
    test: Iterable[str] | None = None,
    on_nan: str = "error",
    calibration: PhaseCalibration | CalibrationSettings | Mapping[str, Any] | None = None,
    facts: RecordingFacts | None = None,
    work: Work | None = None,
    **settings: Any,
) -> IdentifiedModels:
    """Identify Koopman and linear models of every unit of a population.

    Parameters
    ----------
    population : Population
    lifting : sequence of str, mapping, Lifting or None
        Lifted functions, such as ``["sin(100*position + phase)"]``, or a table as ``[lifting]`` of a study. Default: that of the plant
        that the recordings name, else linear models alone.
    identify_on : str, optional
        Condition that feeds synthesis; default ``noload``, else the first.
    test : iterable of str, optional
        Names of held-out episodes; default the last tenth of each unit and condition.
    on_nan : {"error", "drop_episode"}
        What is done with episodes that hold NaN or infinity.
    calibration : mapping or PhaseCalibration, optional
        How the lifting's parameter ``phase`` is calibrated, as ``[calibrate]`` of a study, or its known values.
    facts : RecordingFacts, optional
        Of a `survey` that was made already.
    work : Work, optional
        Where it runs.
    **settings
        Of `IdentifySettings`: ``alpha``, ``alpha_factor``, ``refine``.

    Returns
    -------
    IdentifiedModels

    Raises
    ------
    DataError, ConfigError
        When recordings or settings cannot be used.
    IdentificationError
        When no stable models are found, or too few units can be calibrated.

    Examples
    --------
    >>> import kros
    >>> drives = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> kros.identify(drives, refine=False)
    <IdentifiedModels: linear_edmd of 2 units, identified on 'default'>
    """
    require_kind(
        population,
        Population,
        "Identify",
        "read recordings with kros.read, or make a population of arrays with kros.from_arrays",
    )
    asked, work = IdentifySettings.of(settings, "Identify"), work or Work()
    if facts is None:
        check_usable(population, test, identify_on, single_allowed=True)
        population, facts = survey(population, work, test=test, identify_on=identify_on, on_nan=on_nan)
    known = isinstance(calibration, PhaseCalibration)
    declared = CalibrationSettings() if known else CalibrationSettings.of(calibration or {}, "Calibrate")
    found = (
        lifting
        if isinstance(lifting, Lifting)
        else resolve_lifting(lifting_settings(lifting), declared, population, test)
    )
    if not known:
        spec = resolve_phase(declared, population, found)
        calibration = None if spec is None else calibrate(population, facts, spec, work)
    base = IdentifiedModels(
        population, facts, found, calibration if isinstance(calibration, PhaseCalibration) else None
    )
    if facts.identify_on not in base.conditions:
        raise IdentificationError(
            f"Identifying in condition {facts.identify_on!r}: none of the units recorded in it could be calibrated; set data.identify_on to another one."
        )
    elsewhere = [u for u in facts.pooled if not facts.keys("train", u, facts.identify_on)]
    if elsewhere:
        log.warning(
            "Units %s were not recorded in condition %r, which feeds synthesis: they take no part in it, and are not compared with the others. "
            "Where conditions stand for units, give all the same one.",
            ", ".join(elsewhere),
            facts.identify_on,
        )
    sets, factors, refined = dict[str, ModelSet](), dict[str, EpisodeFactors](), dict[str, RefinedModels]()
    first = sorted(
        base.conditions, key=lambda c: c != facts.identify_on
    )  # its models are refined while the others are identified
    identified = {condition: identify_condition(base, condition, asked, work) for condition in first}
    for condition in base.conditions:
        factors[condition], models, refining = identified[condition]
        better, found_out = refining()
        sets |= {base.place(m.name, condition): m for m in (*models, *better)}
        refined |= found_out
    refined_kinds = tuple(kind.name for kind in kinds_for(found, refined=True)) if asked.refine else ()
    return replace(base, kinds=refined_kinds + base.edmd_kinds, sets=sets, factors=factors, refined=refined)


def identify_condition(
    base: IdentifiedModels, condition: str, settings: IdentifySettings, work: Work
) -> tuple[EpisodeFactors, list[ModelSet], Refining]:
    """Reduce the training episodes of one condition, identify every kind of model from them, and begin to refine those that feed synthesis."""
    population, facts, own = base.population, base.facts, base.parameters
    units = [u for u in facts.groups if u in own and facts.keys("train", u, condition)]
    tasks = [(population.select([u], [condition]), facts.keys("train", u, condition), base.lifting) for u in units]
    episodes = list(
        work.recall(f"identify ({condition})", reduce_episodes, tasks, factor_marks(facts, tasks), (Factor,))
    )
    factor = Factor.stack([combine(f) for f in episodes])
    parameters = {name: np.array([own[u][name] for u in units]) for name in base.lifting.parameters}
    longest_s = max(int(f.n_samples.max()) for f in episodes) * population.sample_period_s
    models = [
        replace(m, longest_s=longest_s) for m in identify_models(base, condition, units, factor, parameters, settings)
    ]
    wanted = settings.refine and condition == facts.identify_on
    refining = begin_refinement(base, units, factor, parameters, models, work) if wanted else _not_refined
    rows = tuple((k.unit, k.episode) for u in units for k in facts.keys("train", u, condition))
    together = Factor(*(np.concatenate([getattr(f, name) for f in episodes]) for name in ("R", "peak", "n_samples")))
    return EpisodeFactors(condition, rows, together), models, refining


def factor_marks(facts: RecordingFacts, tasks: Iterable[Task]) -> list[str | None]:
    """Return what the factors of each task follow from: samples, what they are of, and the lifting but for its parameters' values."""
    found = [(facts.marks(keys), population, keys, lifting) for population, keys, lifting in tasks]
    return [
        None if known is None else mark_of(known, keys, own.channels, repr(lifting))
        for known, own, keys, lifting in found
    ]


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


def identify_models(
    base: IdentifiedModels,
    condition: str,
    units: list[str],
    factor: Factor,
    parameters: dict[str, Array],
    settings: IdentifySettings,
) -> list[ModelSet]:
    """Identify every kind of model of one condition with one common regularisation."""
    population, on = base.population, condition == base.facts.identify_on
    liftings = {kind.name: kind.lifting(base.lifting) for kind in kinds_for(base.lifting, refined=False)}
    factors = {kind: lifted_factor(factor, base.lifting, parameters, lifting) for kind, lifting in liftings.items()}
    in_pool = set(base.facts.pooled)
    pooled = np.array([u in in_pool for u in units])
    rows = pooled if pooled.any() else slice(None)
    ranges = {kind: Ranges.of(factors[kind], lifting.n_lifted, rows) for kind, lifting in liftings.items()}
    alpha = settings.alpha
    if alpha == "auto":
        shared = [
            (ranges[kind].triangles(factors[kind].R[rows]), lifting.n_lifted) for kind, lifting in liftings.items()
        ]
        edge = smallest_stabilising_alpha(shared)
        times = alpha_factor(shared, edge, settings.alpha_factor) if on else settings.alpha_factor
        alpha = times * edge
        note = (
            "%s: alpha = %.4g for channels divided by their ranges, %g times the smallest that stabilises every model"
        )
        log.info(note, condition, alpha, times)
    require_excitation(factor, population.inputs, units, condition, float(alpha))
    if alpha == 0:
        for kind, lifting in liftings.items():
            require_independent(
                factors[kind], lifting.names + population.inputs + lifting.input_functions, units, condition
            )
    models = []
    for kind, lifting in liftings.items():
        nothing = np.zeros((len(units), 0, 0))
        unfitted = ModelSet(
            name=kind,
            condition=condition,
            lifting=lifting,
            channels=population.channels,
            sample_period_s=population.sample_period_s,
            unit_ids=tuple(units),
            A=nothing,
            B=nothing,
            parameters=parameters if lifting.parameters else {},
            residual_covariance=nothing,
            output_scale=ranges[kind].outputs,
            input_scale=ranges[kind].inputs,
            alpha=float(alpha),
            alpha_in_ranges=settings.alpha == "auto",
        )
        models.append(fitted(unfitted, factors[kind]))
    if on:
        for found in models:
            require_stable(found, pooled)
    return models


def fitted(models: ModelSet, factor: Factor) -> ModelSet:
    """Return a set of models fitted to factors of its units; a regularisation that was searched acts on channels divided by their ranges."""
    matrices = models.fit(factor.R)
    radius = models.ranges.normalise(matrices).spectral_radius()
    return replace(
        models,
        A=matrices.A,
        B=matrices.B,
        residual_covariance=residual_covariance(factor.R, models.lifting.n_lifted, matrices, factor.n_samples),
        status=tuple("ok" if r < 1 else f"unstable, spectral radius {radius_text(r)}" for r in radius),
    )


def alpha_factor(shared: list[tuple[Array, int]], edge: float, smallest: float) -> float:
    """Return how many times the smallest stabilising coefficient is taken."""
    limit = 20 * np.log10(LARGEST_RESIDUAL)
    for doubled in range(_DOUBLINGS if edge > 0 else 0):
        factor = smallest * 2.0**doubled
        models = [edmd(R, n, factor * edge) for R, n in shared]
        if not any(
            peak_residual_db(m.A, m.B, np.ones(m.B.shape[1]), np.ones(m.B.shape[2]), _POINTS) > limit for m in models
        ):
            return factor
    return smallest


def begin_refinement(
    base: IdentifiedModels,
    units: list[str],
    factor: Factor,
    parameters: dict[str, Array],
    starts: list[ModelSet],
    work: Work,
) -> Refining:
    """Begin to refine every kind of model on free-run error, the population first, then each unit with a prior centred on it."""
    facts = base.facts
    keys = {u: facts.keys("train", u, facts.identify_on) for u in units}
    in_pool = set(facts.pooled)
    pooled = np.array([u in in_pool for u in units])
    factors = [lifted_factor(factor, base.lifting, parameters, start.lifting) for start in starts]
    tasks = [
        partial(refine_population, base.population, keys, start.lifting, start.parameters, lifted, pooled)
        for start, lifted in zip(starts, factors, strict=True)
    ]
    results = work.begin("identify (refine)", tasks)

    def refining() -> tuple[list[ModelSet], dict[str, RefinedModels]]:
        refined, kinds = results(), kinds_for(base.lifting, refined=True)
        models = [
            with_matrices(start, kind.name, found.units, lifted)
            for kind, start, found, lifted in zip(kinds, starts, refined, factors, strict=True)
        ]
        return models, {m.name: found for m, found in zip(models, refined, strict=True)}

    return refining


def _not_refined() -> tuple[list[ModelSet], dict[str, RefinedModels]]:
    return [], {}


def with_matrices(start: ModelSet, name: str, matrices: KoopmanMatrices, lifted: Factor) -> ModelSet:
    """Return a refined model set with the scales and phases of the one it started from."""
    return replace(
        start,
        name=name,
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
