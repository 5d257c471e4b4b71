"""Stage: choose the nominal unit, quantify how the others differ from it, cover that by weights, score every unit."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ...core.artifacts import save_artifact, write_json
from ...core.errors import IdentificationError
from ...identify import ModelSet
from ...uncertainty import Form, OutlierScore, UncertainModel, choose_nominals, quantify_systems, residual, score_outliers, sigma_max
from ...uncertainty.settings import UncertaintySettings
from ..engine.context import Context
from ..responses import scaled_responses
from ..scoring import Recorded
from .diagnose import diagnose

log = logging.getLogger(__name__)


def run(context: Context) -> None:
    """Score outliers first, so that flagged units can be dropped where the study asks for it; then quantify."""
    scores = score_units(context)
    dropped = {row["unit"] for row in scores if row["outlier"]} if context.config.uncertainty.drop_outliers else set()
    units = [u for u in context.facts.pooled if u in context.models(context.model_names[0]).unit_ids and u not in dropped]
    if len(units) < 2:
        raise IdentificationError(
            f"Uncertainty: {len(units)} units are left of {len(context.facts.pooled)}, at least two are needed; dropped are {sorted(dropped)}."
        )
    folder = context.store.draft("uncertainty")
    sets = {name: context.models(name) for name in context.model_names}
    first = next(iter(sets.values()))
    nominal = choose_nominal(first, units, context.config.uncertainty)
    tasks = [partial(quantify_models, models, units, context.config.uncertainty, nominal) for models in sets.values()]
    found = context.work.run("quantify", tasks)
    for name, uncertain in zip(sets, found, strict=True):
        uncertain.save(folder / name)
    choice = {"nominal": nominal, "worst_off_nominal": worst_off_nominal(first, found[0]), "dropped": sorted(dropped)}
    save_artifact(folder, "choice", choice)
    diagnose(context, units, dict(zip(sets, found, strict=True)), scores)


def choose_nominal(models: ModelSet, units: list[str], config: UncertaintySettings) -> str:
    """Return the nominal unit: the one asked for, else the best of the first kind of models, which all others share as in the paper."""
    if config.nominal is None:
        responses = scaled_responses(models, units, models.frequencies(config.n_freqs))
        return units[choose_nominals(responses)[Form(config.form)].index]
    if config.nominal not in units:
        raise IdentificationError(f"uncertainty.nominal = {config.nominal!r}: is not among the units {', '.join(units)}; name one of them.")
    return config.nominal


def quantify_models(models: ModelSet, units: list[str], config: UncertaintySettings, nominal: str) -> UncertainModel:
    """Quantify one kind of model over the pooled units."""
    return quantify_systems(
        models.systems(units),
        config.form,
        models.frequencies(config.n_freqs),
        unit_ids=units,
        output_scale=models.output_scale,
        input_scale=models.input_scale,
        nominal=nominal,
        structure=config.structure,
        max_order=config.max_order,
        tolerance_db=config.tolerance_db,
    )


def worst_off_nominal(models: ModelSet, uncertain: UncertainModel) -> str:
    """Return the unit with the largest residual against the nominal one."""
    responses = scaled_responses(models, list(uncertain.unit_ids), uncertain.freqs_hz)
    peaks = sigma_max(residual(uncertain.form, responses[uncertain.nominal], responses)).max(axis=-1)
    peaks[uncertain.nominal] = -np.inf
    return uncertain.unit_ids[int(np.argmax(peaks))]


def score_units(context: Context) -> list[dict[str, Any]]:
    """Score every unit against the others in every condition, whatever group it is filed under; return a row a score."""
    name = context.edmd_names[0]
    folder = context.store.draft("outliers")
    rows: list[dict[str, Any]] = []
    for condition in context.population.conditions:
        place = context.model_folder(name, condition)
        if not context.store.holds("models", place, "model.json"):
            continue
        models = context.models(name, condition)
        if len(models.unit_ids) < 3:
            log.info("%s: outlier scores need at least three units, found %d", condition, len(models.unit_ids))
            continue
        freqs = models.frequencies(context.config.uncertainty.n_freqs)
        recorded = Recorded.load(context.store, models, freqs)
        evidence = list(recorded.units.values())
        outliers = score_outliers(
            recorded.response(evidence),
            freqs,
            context.config.uncertainty.outlier_form,
            unit_ids=models.unit_ids,
            output_scale=models.output_scale,
            input_scale=models.input_scale,
            false_alarm_rate=context.config.uncertainty.false_alarm_rate,
            deviations=[recorded.deviations(e) for e in evidence],
        )
        judged = tuple(recorded.judged(*pair) for pair in zip(outliers.scores, evidence, strict=True))
        outliers = replace(outliers, scores=judged)
        outliers.save(folder / place)
        for score, found in zip(outliers.scores, evidence, strict=True):
            keys, used = (context.facts.keys(part, score.unit, condition) for part in ("test", "train"))
            seconds = found.n_samples * models.sample_period_s * (1 + len(keys) / len(used))  # episodes that are held out, like the others
            rows.append(score_row(score, condition, len(keys) + len(used), seconds))
    write_json(folder / "scores.json", {"schema": 1, "rows": rows})
    return rows


def score_row(score: OutlierScore, condition: str, episodes: int, recorded_s: float) -> dict[str, Any]:
    """Return a score as a row of metrics.

    Parameters
    ----------
    score : OutlierScore
    condition : str
    episodes : int
        Recorded, those that are held out among them.
    recorded_s : float, s

    Returns
    -------
    dict
        ``unit, condition, score, threshold`` (dB), ``outlier``; ``status``; where the score comes from; ``detectable``, the smallest change of gain
        that would have been flagged in percent, with ``detectable_db``, ``detectable_hz`` and ``detectable_entry`` (output, input); ``episodes`` and
        ``recorded_s``, and what would be needed of both.
    """
    row = {"unit": score.unit, "condition": condition, "score": score.score_db, "threshold": score.threshold_db, "outlier": score.outlier}
    row |= {key: getattr(score, key) for key in ("freq_hz", "entry", "excess_db", "lowest_db", "highest_db", "agreement")}
    row |= {"status": score.status, "detectable": score.detectable_percent}
    row |= {key: getattr(score, key) for key in ("detectable_db", "detectable_hz", "detectable_entry")}
    needed = {"needed_episodes": int(np.ceil(episodes * score.more_data)), "needed_s": recorded_s * score.more_data}
    return row | {"episodes": episodes, "recorded_s": recorded_s} | needed
