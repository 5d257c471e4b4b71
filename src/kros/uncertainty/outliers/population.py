"""Outlier scores of a population: every unit against the others, in every condition."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from typing import Any

from ...core.work import Work
from ...identify import ModelSet
from ...identify.identified import EpisodeFactors, IdentifiedModels
from ..settings import QuantifySettings
from .model import OutlierModel, score_outliers, scored_rows
from .recorded import Recorded
from .score import OutlierScore
from .tail import LEAST_SCORES

log = logging.getLogger(__name__)


def score_population(
    models: IdentifiedModels, settings: QuantifySettings, work: Work | None = None
) -> tuple[dict[str, OutlierModel], list[dict[str, Any]]]:
    """Score every unit in every condition, whatever its group."""
    places = {condition: models.place(models.edmd_kinds[0], condition) for condition in models.population.conditions}
    known = {condition: models.sets[place] for condition, place in places.items() if place in models.sets}
    scored = {
        condition: identified for condition, identified in known.items() if len(identified.unit_ids) >= LEAST_SCORES
    }
    for condition in sorted(known.keys() - scored.keys()):
        log.info("%s: outlier scores need at least three units", condition)
    tasks = [partial(score_condition, models.factors[c], identified, settings) for c, identified in scored.items()]
    rows: list[dict[str, Any]] = []
    found: dict[str, OutlierModel] = {}
    for condition, (outliers, samples) in zip(scored, (work or Work()).run("score outliers", tasks), strict=True):
        found[places[condition]] = outliers
        for score, n_samples in zip(outliers.scores, samples, strict=True):
            keys, used = (models.facts.keys(part, score.unit, condition) for part in ("test", "train"))
            held_out = 1 + len(keys) / len(used)  # episodes that are held out are as long as the others
            seconds = n_samples * scored[condition].sample_period_s * held_out
            rows.append(score_row(score, condition, len(keys) + len(used), seconds))
    return found, rows


def score_condition(
    factors: EpisodeFactors, models: ModelSet, settings: QuantifySettings
) -> tuple[OutlierModel, list[int]]:
    """Score all units in one condition; with every unit's number of samples."""
    freqs = models.frequencies(settings.n_freqs)
    freqs = freqs[scored_rows(len(freqs))]
    recorded = Recorded.of(factors, models, freqs)
    evidence = list(recorded.units.values())
    responses, ids = recorded.response(evidence), models.unit_ids
    enough = [k for k, data in enumerate(evidence) if recorded.suffices(data)]
    well = enough if len(enough) >= LEAST_SCORES else list(range(len(ids)))
    outliers = score_outliers(
        responses[well],
        freqs,
        settings.outlier_form,
        unit_ids=tuple(ids[k] for k in well),
        output_scale=models.output_scale,
        input_scale=models.input_scale,
        false_alarm_rate=settings.false_alarm_rate,
    )
    known = {score.unit: score for score in outliers.scores}
    scores = [known.get(unit) or outliers.score(unit, G) for unit, G in zip(ids, responses, strict=True)]
    qualified = tuple(recorded.qualified(*pair) for pair in zip(scores, evidence, strict=True))
    return replace(outliers, scores=qualified), [data.n_samples for data in evidence]


def score_row(score: OutlierScore, condition: str, episodes: int, recorded_s: float) -> dict[str, Any]:
    """Return a score as a row of metrics, with what was recorded and what is needed."""
    same = ("outlier", "freq_hz", "excess_db", "lowest_db", "highest_db", "status", "detectable_hz")
    row = {"unit": score.unit, "condition": condition, "score": score.score_db, "threshold": score.threshold_db}
    row |= {key: getattr(score, key) for key in same} | {"detectable": score.detectable_percent}
    return row | {"episodes": episodes, "recorded_s": recorded_s, "needed_s": recorded_s * score.more_data}
