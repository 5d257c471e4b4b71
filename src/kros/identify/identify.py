"""The verb: from a population's recordings to models of every unit.

recordings --survey--> training episodes --calibrate--> parameters of the lifting
training episodes --one pass--> factors --EDMD, one regularisation for all--> koopman_edmd, linear_edmd in every
condition
those of the condition that feeds synthesis --refined on free-run error--> koopman, linear, in their place
"""

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ..core import Array, ByName, Flags, IdentificationError, Names, Record, Work, frozen, require_kind
from ..core.linalg import radius_text
from ..data import Population
from ..lifting import Lifting
from .calibration import PhaseCalibration, calibrate
from .edmd import AlphaSearch, edmd, smallest_stabilising_alpha
from .factors import Factor, Ranges, combine, lifted_factor, reduce_episodes, require_excitation
from .identified import EpisodeFactors, IdentifiedModels
from .model_set import ModelSet, kinds_for
from .presets import lifting_settings, resolve_lifting, resolve_phase
from .refine import refine_population
from .refine.metric import peak_residual
from .settings import CalibrationSettings, IdentifySettings, LiftingSettings
from .survey import check_usable, survey

log = logging.getLogger(__name__)


def identify(
    population: Population,
    lifting: Lifting | LiftingSettings | ByName | Sequence[str] | None = None,
    *,
    identify_on: str | None = None,
    test: Iterable[str] | None = None,
    on_nan: str = "error",
    calibration: PhaseCalibration | CalibrationSettings | ByName | None = None,
    work: Work | None = None,
    **settings: Any,
) -> IdentifiedModels:
    """Identify Koopman and linear models of every unit of a population.

    Parameters
    ----------
    population : Population
    lifting : sequence of str, mapping, Lifting or None
        Lifted functions, such as ``["sin(100*position + phase)"]``, or a table as ``[lifting]`` of a study. Default:
        that of the plant that the recordings name, else linear models alone.
    identify_on : str, optional
        Condition that feeds synthesis; default ``noload``, else the first.
    test : iterable of str, optional
        Names of held-out episodes; default the last tenth of each unit and condition.
    on_nan : {"error", "drop_episode"}
        What is done with episodes that hold NaN or infinity.
    calibration : mapping or PhaseCalibration, optional
        How the lifting's parameter ``phase`` is calibrated, as ``[calibrate]`` of a study, or its known values.
    work : Work, optional
        Where it runs.
    **settings
        Of `IdentifySettings`: ``alpha``, ``refine``.

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
    remedy = "read recordings with kros.read, or make a population of arrays with kros.from_arrays"
    require_kind(population, Population, "Identify", remedy)
    chosen, work = IdentifySettings.of(settings, "Identify"), work or Work()
    check_usable(population, test, identify_on, single_allowed=True)
    population, facts = survey(population, work, test=test, identify_on=identify_on, on_nan=on_nan)
    known = calibration if isinstance(calibration, PhaseCalibration) else None
    declared = CalibrationSettings.of({} if known else calibration or {}, "Calibrate")
    if not isinstance(lifting, Lifting):
        lifting = resolve_lifting(lifting_settings(lifting), declared, population, test)
    if known is None and (spec := resolve_phase(declared, population, lifting)):
        known = calibrate(population, facts, spec, work)
    return with_models(IdentifiedModels(population, facts, lifting, known), chosen, work)


def with_models(base: IdentifiedModels, settings: IdentifySettings, work: Work) -> IdentifiedModels:
    """Return surveyed recordings, with a known lifting and its calibration, with their models.

    A condition without units is refused; the log names units that were not recorded in the one that feeds synthesis.
    """
    facts = base.facts
    if facts.identify_on not in base.conditions:
        raise IdentificationError(f"No unit could be calibrated in {facts.identify_on!r}; set data.identify_on.")
    elsewhere = [u for u in facts.pooled if not facts.keys("train", u, facts.identify_on)]
    if elsewhere:
        text = "Units %s were not recorded in condition %r, which feeds synthesis, and take no part in it"
        log.warning(text, ", ".join(elsewhere), facts.identify_on)
    begun = {c: _begin(base, c, settings, work) for c in base.conditions}  # refined while others are identified
    sets, factors = dict[str, ModelSet](), dict[str, EpisodeFactors]()
    for condition, (recorded, models, refining) in begun.items():
        factors[condition] = recorded
        sets |= {base.place(m.name, condition): m for m in (*models, *refining())}
    return replace(base, kinds=tuple(kinds_for(base.lifting, refined=settings.refine)), sets=sets, factors=factors)


def _begin(
    base: IdentifiedModels, condition: str, settings: IdentifySettings, work: Work
) -> tuple[EpisodeFactors, list[ModelSet], Callable[[], list[ModelSet]]]:
    """Reduce and identify the training episodes of one condition, and begin to refine models that feed synthesis."""
    population, facts, values = base.population, base.facts, base.parameters
    units = [u for u in facts.groups if u in values and facts.keys("train", u, condition)]
    tasks = [(population.select([u], [condition]), facts.keys("train", u, condition), base.lifting) for u in units]
    episodes = list(work.recall(f"identify ({condition})", reduce_episodes, tasks, map(facts.mark, tasks), Factor))
    parameters = {name: np.array([values[u][name] for u in units]) for name in base.lifting.parameters}
    reduced = _Reduced(base, condition, tuple(units), Factor.stack([combine(f) for f in episodes]), parameters)
    longest_s = max(int(f.n_samples.max()) for f in episodes) * population.sample_period_s
    models = [replace(m, longest_s=longest_s) for m in reduced.identify(settings)]
    rows = tuple((k.unit, k.episode) for u in units for k in facts.keys("train", u, condition))
    refining = reduced.begin_refinement(models, work) if settings.refine and reduced.feeds_synthesis else list
    return EpisodeFactors(condition, rows, Factor.stack(episodes, np.concatenate)), models, refining


@frozen
class _Reduced:
    """Training episodes of one condition, reduced to factors of every unit."""

    base: IdentifiedModels
    condition: str
    units: Names
    factor: Factor
    parameters: dict[str, Array]

    @property
    def feeds_synthesis(self) -> bool:
        """Whether this is the condition that the observer is designed in."""
        return self.condition == self.base.facts.identify_on

    @property
    def pooled(self) -> Flags:
        """Units that speak for the population."""
        return np.isin(self.units, list(self.base.facts.pooled))

    @property
    def rows(self) -> Flags | slice:
        """Rows of these units; of all where there are none."""
        return self.pooled if self.pooled.any() else slice(None)

    def lifted(self, lifting: Lifting) -> Factor:
        """Return factors for a kind of model."""
        return lifted_factor(self.factor, self.base.lifting, self.parameters, lifting)

    def identify(self, settings: IdentifySettings) -> list[ModelSet]:
        """Identify every kind of model with one common regularisation."""
        kinds = kinds_for(self.base.lifting, refined=False)
        factors = [self.lifted(lifting) for lifting in kinds.values()]
        require_excitation(factors[-1], self.base.population.inputs, self.condition)
        sets = [self._unfitted(*kind, factor) for kind, factor in zip(kinds.items(), factors, strict=True)]
        alpha = self._search(sets, factors) if settings.alpha == "auto" else settings.alpha
        sets = [replace(m, alpha=alpha, alpha_in_ranges=settings.alpha == "auto") for m in sets]
        models = [fitted(m, factor) for m, factor in zip(sets, factors, strict=True)]
        for m in models if self.feeds_synthesis else ():
            for unit, status, counts in zip(m.unit_ids, m.status, self.pooled, strict=True):
                if counts and status != "ok":
                    raise IdentificationError(
                        f"Identifying {m.name} of unit {unit} ({m.condition}) with alpha = {m.alpha:g}: the "
                        f"model is {status}; set identify.alpha = 'auto', or raise it."
                    )
        return models

    def _unfitted(self, kind: str, lifting: Lifting, factor: Factor) -> ModelSet:
        population, ranges = self.base.population, Ranges.of(factor, lifting.n_lifted, self.rows)
        nothing = np.zeros((len(self.units), 0, 0))
        return ModelSet(
            name=kind,
            condition=self.condition,
            lifting=lifting,
            channels=population.channels,
            sample_period_s=population.sample_period_s,
            unit_ids=self.units,
            A=nothing,
            B=nothing,
            parameters=self.parameters if lifting.parameters else {},
            output_scale=ranges.outputs,
            input_scale=ranges.inputs,
        )

    def _search(self, sets: list[ModelSet], factors: list[Factor]) -> float:
        """Return the common regularisation of channels divided by their ranges."""
        pairs = zip(sets, factors, strict=True)
        shared = [(m.ranges.triangles(factor.R[self.rows]), m.lifting.n_lifted) for m, factor in pairs]
        edge, search = smallest_stabilising_alpha(shared), AlphaSearch()
        times = search.factor
        for factor in times * 2.0 ** np.arange(search.doublings if self.feeds_synthesis and edge > 0 else 0):
            models = [edmd(R, n, factor * edge) for R, n in shared]
            if not any(peak_residual(m.A, m.B, search.points) > search.largest_residual for m in models):
                times = float(factor)
                break
        note = "%s: alpha = %.4g for channels over their ranges, %g times the smallest that stabilises every model"
        log.info(note, self.condition, times * edge, times)
        return times * edge

    def begin_refinement(self, starts: list[ModelSet], work: Work) -> Callable[[], list[ModelSet]]:
        """Begin to refine every kind of model on free-run error."""
        base, facts = self.base, self.base.facts
        keys = {u: facts.keys("train", u, facts.identify_on) for u in self.units}
        tasks = [
            partial(
                refine_population, base.population, keys, m.lifting, m.parameters, self.lifted(m.lifting), self.pooled
            )
            for m in starts
        ]
        results = work.begin("identify (refine)", tasks)
        known: Record = {"alpha": None, "alpha_in_ranges": False, "status": ("ok",) * len(self.units)}

        def refining() -> list[ModelSet]:
            of = zip(kinds_for(base.lifting, refined=True), starts, results(), strict=True)
            return [replace(start, name=kind, A=m.A, B=m.B, **known) for kind, start, m in of]

        return refining


def fitted(models: ModelSet, factor: Factor) -> ModelSet:
    """Return a set of models fitted to factors of its units, with its regularisation."""
    matrices = models.fit(factor.R)
    models = replace(models, A=matrices.A, B=matrices.B)
    unstable = (f"unstable, spectral radius {radius_text(r)}" if r >= 1 else "ok" for r in models.spectral_radius())
    return replace(models, status=tuple(unstable))
