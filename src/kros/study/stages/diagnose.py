"""What the report says about the uncertainty beside its weights; later stages use nothing of it.

EDMD models of resampled episodes --> which share of the residuals finite recordings make    uncertainty/<model>/noise
residuals of all units            --> beside the weights                                     uncertainty/<model>/units
the most conspicuous unit         --> against the cover of all the others                    outliers/<models>/others
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ...core import Array, ByName, KrosError, frozen
from ...identify import ModelSet
from ...identify.edmd import bootstrap_edmd, episode_weights
from ...identify.factors import Ranges, lifted_factor
from ...uncertainty import Form, UncertainModel, choose_nominal, residual
from ...uncertainty.forms import evenly
from ...uncertainty.noise import NoiseShare, noise_share
from ...uncertainty.quantify import UncertainModels, residuals_beside_weights
from ...uncertainty.unit_residuals import UnitResiduals, unit_residuals
from ...uncertainty.weights.cover import optimal_cover
from ..engine.context import Context

log = logging.getLogger(__name__)


@frozen
class DiagnosticSettings:
    """Extent of what is computed for the report alone."""

    noise_points: int = 80  # frequencies at which variation and noise are compared
    points: int = 240  # frequencies of residuals
    units: int = 60  # at most, whose models are resampled
    draws: int = 60  # of the episodes of a unit


DEFAULT = DiagnosticSettings()
Result = UnitResiduals | NoiseShare
Task = tuple[Path, Callable[[], Result]]


def diagnose(context: Context, uncertain: UncertainModels) -> None:
    """Compute and save all of it; what cannot be computed is logged with its reason, and absent."""
    folder, models, sets = context.store.draft("uncertainty"), uncertain.models, uncertain.sets
    edmd = dict(zip(models.kinds, map(models.models, models.edmd_kinds), strict=True))
    tasks: list[Task] = [(folder / k / "noise", _noise(context, one, sets[k])) for k, one in edmd.items()]
    tasks += [(folder / k / "units", partial(residuals_beside_weights, models.models(k), sets[k])) for k in edmd]
    tasks += _others(context, uncertain.scores)
    work = [partial(_attempt, place.parent.name, task) for place, task in tasks]
    for (place, _), result in zip(tasks, context.work.run("quantify (diagnose)", work), strict=True):
        if result is not None:
            result.save(place)


def _attempt(name: str, task: Callable[[], Result]) -> Result | None:
    try:
        return task()
    except KrosError as error:
        log.info("%s: not in the report: %s", name, error)
        return None


def _noise(context: Context, models: ModelSet, uncertain: UncertainModel) -> Callable[[], NoiseShare]:
    """Return work that compares variation and noise of EDMD models of some units, the nominal one among them."""
    units = uncertain.unit_ids
    chosen = [units[k] for k in np.union1d(evenly(len(units), DEFAULT.units), [uncertain.nominal])]
    identified, parts = context.identified, []
    recorded = identified.factors[context.facts.identify_on]
    for unit in chosen:
        factor = recorded.factor[recorded.rows_of(unit)]
        values = {n: np.full(len(factor.R), identified.parameters[unit][n]) for n in context.lifting.parameters}
        parts.append(lifted_factor(factor, context.lifting, values, models.lifting).R)
    return partial(_compared, parts, models, uncertain.form, chosen.index(uncertain.nominal_id))


def _compared(parts: Sequence[Array], models: ModelSet, form: Form, nominal: int) -> NoiseShare:
    """Compare the variation of units with that of models of drawn episodes, from the factors of every unit's."""
    assert models.alpha is not None
    counts = [len(part) for part in parts]
    R = np.stack([np.pad(part, ((0, max(counts) - len(part)), (0, 0), (0, 0))) for part in parts])
    ones = Ranges(np.ones_like(models.output_scale), np.ones_like(models.input_scale))
    ranges, weights = models.ranges if models.alpha_in_ranges else ones, episode_weights(counts, DEFAULT.draws, 0)
    samples = bootstrap_edmd(ranges.triangles(R), models.lifting.n_lifted, models.alpha, weights)
    samples = replace(samples, estimate=ranges.restore(samples.estimate), samples=ranges.restore(samples.samples))
    scale = models.output_scale[:, None] / models.input_scale
    return noise_share(samples, scale, models.frequencies(DEFAULT.noise_points), models.sample_period_s, form, nominal)


def _others(context: Context, rows: Sequence[ByName]) -> list[Task]:
    """Compare the most conspicuous unit with the others, where it scores highest; for both kinds as in the paper."""
    scored = [r for r in rows if r["score"] is not None]
    top = max(scored, key=lambda r: (bool(r["outlier"]), float(r["score"])), default=None)
    if top is None:
        return []
    condition, identified, form = top["condition"], context.identified, Form(context.config.uncertainty.form)
    flagged = [r["unit"] for r in rows if r["outlier"] and r["condition"] == condition]
    outside = list(dict.fromkeys([top["unit"], *flagged]))
    sets = [identified.models(name, condition) for name in identified.edmd_kinds]
    others = [u for u, s in zip(sets[0].unit_ids, sets[0].status, strict=True) if s == "ok" and u not in outside]
    if len(others) < 2:
        return []
    responses = sets[0].scaled_responses(sets[0].frequencies(DEFAULT.points), others)
    nominal = others[choose_nominal(responses, form).index]
    places = (context.store.draft("outliers", identified.place(m.name, condition), "others") for m in sets)
    work = (partial(against_others, m, others, outside, nominal, form) for m in sets)
    return list(zip(places, work, strict=True))


def against_others(models: ModelSet, others: list[str], outside: list[str], nominal: str, form: Form) -> UnitResiduals:
    """Return the residuals of all units beside the smallest diagonal cover of `others` at every frequency."""
    freqs, row = models.frequencies(DEFAULT.points), others.index(nominal)
    everyone = [*others, *outside]
    responses = models.scaled_responses(freqs, everyone)
    cover = optimal_cover(residual(form, responses[row], responses[: len(others)]))
    units = dict(zip(everyone, responses, strict=True))
    return unit_residuals(form, (nominal, responses[row]), units, cover, freqs, models.sample_period_s, outside)
