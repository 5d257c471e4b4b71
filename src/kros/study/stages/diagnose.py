"""What the report says about the uncertainty beside its weights; later stages use nothing of it.

residuals of all units      --> beside the weights                        uncertainty/<model>/units
the most conspicuous unit   --> against the cover of all the others       outliers/<models>/others
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ...core.errors import KrosError
from ...identify import ModelSet
from ...uncertainty import Form, UncertainModel, residual
from ...uncertainty.nominal import choose_nominal
from ...uncertainty.quantify import UncertainModels
from ...uncertainty.unit_residuals import UnitResiduals, unit_residuals
from ...uncertainty.weights.cover import optimal_cover
from ..engine.context import Context

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DiagnosticSettings:
    """Extent of what is computed for the report alone."""

    points: int = 240  # frequencies of residuals


DEFAULT = DiagnosticSettings()
Task = tuple[Path, Callable[[], UnitResiduals]]


def diagnose(context: Context, uncertain: UncertainModels) -> None:
    """Compute and save all of it; what cannot be computed is logged with its reason, and absent."""
    folder, models, sets = context.store.draft("uncertainty"), uncertain.models, uncertain.sets
    pair = models.kinds[: len(models.edmd_kinds)]  # that figures compare
    tasks: list[Task] = [(folder / k / "units", partial(beside_weights, models.models(k), sets[k])) for k in pair]
    tasks += _others(context, uncertain.scores)
    work = [partial(_attempt, place.parent.name, task) for place, task in tasks]
    for (place, _), result in zip(tasks, context.work.run("quantify (diagnose)", work), strict=True):
        if result is not None:
            result.save(place)


def _attempt(name: str, task: Callable[[], UnitResiduals]) -> UnitResiduals | None:
    try:
        return task()
    except KrosError as error:
        log.warning("%s: not in the report: %s", name, error)
        return None


def beside_weights(models: ModelSet, uncertain: UncertainModel) -> UnitResiduals:
    """Return the residuals of all covered units beside the weights of a study."""
    freqs = uncertain.freqs_hz[:: max(1, len(uncertain.freqs_hz) // DEFAULT.points)]
    return unit_residuals(
        uncertain.form,
        (uncertain.nominal_id, uncertain.scaled_nominal().frequency_response(freqs)),
        dict(zip(uncertain.unit_ids, models.scaled_responses(freqs, list(uncertain.unit_ids)), strict=True)),
        uncertain.weight,
        freqs,
        models.sample_period_s,
    )


def _others(context: Context, rows: Sequence[Mapping[str, Any]]) -> list[Task]:
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
