"""What the report tells about the uncertainty beside its weights; nothing that later stages use.

models of resampled episodes    --> how much of the residuals finite recordings make    uncertainty/<model>/noise
residuals of all units          --> beside the weights                                  uncertainty/<model>/units
the most conspicuous unit       --> against the cover of all the others                 outliers/<models>/others
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ...core.errors import KrosError
from ...identify import ModelSamples, ModelSet
from ...uncertainty import Form, UncertainModel, VariationAndNoise, residual, variation_and_noise
from ...uncertainty.nominal import choose_nominal
from ...uncertainty.quantify import UncertainModels
from ...uncertainty.settings import UncertaintySettings
from ...uncertainty.unit_residuals import UnitResiduals, unit_residuals
from ...uncertainty.weights.cover import optimal_cover
from ..engine.context import Context
from .resampling import resampling

log = logging.getLogger(__name__)

_NOISE_POINTS, _POINTS = 80, 240  # frequencies
_MOST_UNITS = 60  # whose models are resampled
_ENTRY_ORDER = 3  # of fits to single entries, which are looked at and decide nothing


class _Result(Protocol):
    def save(self, folder: Path) -> None:
        """Write into a folder."""


Task = tuple[Path, Callable[[], _Result | None]]


def diagnose(context: Context, found: UncertainModels) -> None:
    """Compute and save what there is to say; what cannot be said is logged, with its reason, and left out."""
    folder, config = context.store.draft("uncertainty"), context.config.uncertainty
    models = found.models
    noise = [(kind, task) for kind, uncertain in found.sets.items() for task in _noise(context, kind, uncertain)]
    tasks: list[Task] = [(folder / kind / "noise", task) for kind, task in noise]  # those that read recordings begin
    pair = models.kinds[: len(models.edmd_kinds)]  # that figures compare
    tasks += [
        (folder / kind / "units", partial(beside_weights, models.models(kind), found.sets[kind], config))
        for kind in pair
    ]
    tasks += _others(context, found.scores)
    results = context.work.run(
        "quantify (diagnose)", [partial(_attempt, place.parent.name, task) for place, task in tasks]
    )
    for (place, _), result in zip(tasks, results, strict=True):
        if result is not None:
            result.save(place)


def _attempt(name: str, task: Callable[[], _Result | None]) -> _Result | None:
    try:
        return task()
    except KrosError as error:
        log.warning("%s: left out of the report: %s", name, error)
        return None


def _noise(context: Context, name: str, uncertain: UncertainModel) -> list[Callable[[], _Result | None]]:
    """Compare variation and noise over at most 60 units, the nominal one among them."""
    if uncertain.nominal < 0:
        return []
    units = uncertain.unit_ids
    some = np.linspace(0, len(units) - 1, min(_MOST_UNITS, len(units))).round().astype(int)
    chosen = [units[k] for k in np.union1d(some, [uncertain.nominal])]
    models = context.identified.models(name)
    try:
        resample = resampling(context, name, chosen)
    except KrosError as error:
        _not_told_apart(name, error)
        return []
    compare = partial(
        variation_and_noise,
        freqs_hz=models.frequencies(_NOISE_POINTS),
        sample_period_s=models.sample_period_s,
        form=uncertain.form,
        nominal=chosen.index(uncertain.nominal_id),
        output_scale=models.output_scale,
        input_scale=models.input_scale,
    )
    return [partial(_compared, name, resample, compare)]


def _compared(
    name: str, resample: Callable[[], ModelSamples], compare: Callable[[ModelSamples], VariationAndNoise]
) -> VariationAndNoise | None:
    try:
        samples = resample()
    except KrosError as error:
        _not_told_apart(name, error)
        return None
    return compare(samples)


def _not_told_apart(name: str, error: KrosError) -> None:
    log.info("%s: variation and noise are not told apart: %s", name, error)


def beside_weights(models: ModelSet, uncertain: UncertainModel, config: UncertaintySettings) -> UnitResiduals:
    """Return the residuals of all covered units beside the weights of a study."""
    every = max(1, len(uncertain.freqs_hz) // _POINTS)
    freqs = uncertain.freqs_hz[::every]
    return unit_residuals(
        uncertain.form,
        uncertain.scaled_nominal().frequency_response(freqs),
        models.scaled_responses(freqs, list(uncertain.unit_ids)),
        uncertain.weight,
        freqs,
        models.sample_period_s,
        unit_ids=uncertain.unit_ids,
        nominal_id=uncertain.nominal_id,
        max_order=min(config.max_order, _ENTRY_ORDER),
        tolerance_db=config.tolerance_db,
    )


def _others(context: Context, rows: Sequence[Mapping[str, Any]]) -> list[Task]:
    """The most conspicuous unit against the others, in the condition where it scores highest; both kinds of models as in the paper."""
    top = most_conspicuous(rows)
    if top is None:
        return []
    condition = top["condition"]
    outside = [
        top["unit"],
        *(r["unit"] for r in rows if r["outlier"] and r["condition"] == condition and r["unit"] != top["unit"]),
    ]
    sets = [context.identified.models(name, condition) for name in context.identified.edmd_kinds]
    others = [
        u for u, state in zip(sets[0].unit_ids, sets[0].status, strict=True) if state == "ok" and u not in outside
    ]
    if len(others) < 2:
        return []
    responses = sets[0].scaled_responses(sets[0].frequencies(_POINTS), others)
    nominal = others[choose_nominal(responses, context.config.uncertainty.form).index]
    return [
        (
            context.store.draft("outliers", context.identified.place(models.name, condition), "others"),
            partial(against_others, models, others, outside, nominal, context.config.uncertainty),
        )
        for models in sets
    ]


def most_conspicuous(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """Return the row of the highest score, flagged ones first; None where nothing was scored."""
    scored = [r for r in rows if r["score"] is not None]
    return max(scored, key=lambda r: (bool(r["outlier"]), float(r["score"])), default=None)


def against_others(
    models: ModelSet, others: list[str], outside: list[str], nominal: str, config: UncertaintySettings
) -> UnitResiduals:
    """Return the residuals of all units beside the smallest diagonal cover of `others`, frequency by frequency, and beside fits to their entries."""
    freqs, form, row = models.frequencies(_POINTS), Form(config.form), others.index(nominal)
    everyone = [*others, *outside]
    responses = models.scaled_responses(freqs, everyone)
    cover = optimal_cover(residual(form, responses[row], responses[: len(others)]))
    return unit_residuals(
        form,
        responses[row],
        responses,
        cover,
        freqs,
        models.sample_period_s,
        unit_ids=everyone,
        nominal_id=nominal,
        outside=outside,
        max_order=min(config.max_order, _ENTRY_ORDER),
        tolerance_db=config.tolerance_db,
    )
