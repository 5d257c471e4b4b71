"""Outlier scores of a population: every unit against the others, in every condition.

    factors of episodes --brought to one number of samples--> EDMD --> response of a unit

At one alpha of Tikhonov a unit that was recorded less is drawn further towards zero, which looks like another machine.
For scores every unit counts as recorded as long as the middle one of the study; of a unit recorded for less than half
as long nothing is said, because shorter recordings scatter more.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from ...core import AnyArray, Record, Work, frozen
from ...identify import Factor, ModelSet, combine
from ...identify.factors import lifted_factor
from ...identify.identified import EpisodeFactors, IdentifiedModels
from ...identify.likeness import unlike
from ..forms import evenly
from ..settings import OUTLIER, QuantifySettings
from .model import OutlierModel, score_outliers
from .score import OutlierScore, Status
from .tail import LEAST_SCORES

log = logging.getLogger(__name__)


def score_population(
    models: IdentifiedModels, settings: QuantifySettings, work: Work
) -> tuple[dict[str, OutlierModel], list[Record]]:
    """Score every unit in every condition, whatever its group."""
    places = {condition: models.place(models.edmd_kinds[0], condition) for condition in models.population.conditions}
    known = {condition: models.sets[place] for condition, place in places.items() if place in models.sets}
    scored = {condition: one for condition, one in known.items() if len(one.unit_ids) >= LEAST_SCORES}
    for condition in sorted(known.keys() - scored.keys()):
        log.info("%s: outlier scores need at least three units", condition)
    tasks = [partial(score_condition, models.factors[c], identified, settings) for c, identified in scored.items()]
    rows, found = list[Record](), dict[str, OutlierModel]()
    for condition, (outliers, samples) in zip(scored, work.run("score outliers", tasks), strict=True):
        found[places[condition]] = outliers
        for score, n_samples in zip(outliers.scores, samples, strict=True):
            keys, used = (models.facts.keys(part, score.unit, condition) for part in ("test", "train"))
            held_out = 1 + len(keys) / len(used)  # episodes that are held out are as long as the others
            seconds = n_samples * scored[condition].sample_period_s * held_out
            rows.append(score_row(score, scored[condition], len(keys) + len(used), seconds))
    return found, rows


def score_condition(
    factors: EpisodeFactors, models: ModelSet, settings: QuantifySettings
) -> tuple[OutlierModel, list[int]]:
    """Score all units in one condition; with every unit's number of samples."""
    freqs = models.frequencies(settings.n_freqs)
    freqs = freqs[evenly(len(freqs), OUTLIER.frequencies)]
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
        false_alarm_rate=settings.false_alarm_rate,
    )
    known = {score.unit: score for score in outliers.scores}
    scores = [known.get(unit) or outliers.score(unit, G) for unit, G in zip(ids, responses, strict=True)]
    qualified = tuple(recorded.qualified(*pair) for pair in zip(scores, evidence, strict=True))
    return replace(outliers, scores=qualified), [data.n_samples for data in evidence]


def score_row(score: OutlierScore, models: ModelSet, episodes: int, recorded_s: float) -> Record:
    """Return a score as a row of metrics, with what was recorded and what is needed."""
    same = ["outlier", "freq_hz", "excess_db", "lowest_db", "highest_db", "status", "fewest_units"]
    states = dict(zip(models.lifting.states, score.detectable_percent, strict=False))
    hidden = [name for i, name in enumerate(states) if i not in models.measured] or list(states)
    return {
        "unit": score.unit,
        "condition": models.condition,
        "score": score.score_db,
        "threshold": score.threshold_db,
        **{key: getattr(score, key) for key in same},
        "detectable": {name: states[name] for name in hidden},
        "episodes": episodes,
        "recorded_s": recorded_s,
        "needed_s": recorded_s * score.more_data,
    }


@frozen
class Evidence:
    """Episodes that a unit is identified from."""

    factor: Factor  # parameter-free, batch (episode,)
    lifted: Factor  # of ``[Psi | Theta_plus]``

    @classmethod
    def of(cls, factor: Factor, models: ModelSet, parameters: Mapping[str, float]) -> Evidence:
        """Lift the factors of one unit's episodes."""
        values = {name: np.full(len(factor.R), parameters[name]) for name in models.lifting.parameters}
        return cls(factor, lifted_factor(factor, models.lifting, values, models.lifting))

    @property
    def n_samples(self) -> int:
        """Samples of all episodes."""
        return int(self.factor.n_samples.sum())


@frozen
class Recorded:
    """What a study recorded in one condition."""

    models: ModelSet  # of the kind that is scored
    units: Mapping[str, Evidence]  # training episodes of every unit of `models`
    freqs_hz: AnyArray  # (frequency,), Hz

    @classmethod
    def of(cls, factors: EpisodeFactors, models: ModelSet, freqs_hz: AnyArray) -> Recorded:
        """Take the units of models from the factors of all training episodes of a condition."""
        rows = {unit: factors.factor[factors.rows_of(unit)] for unit in models.unit_ids}
        units = {unit: Evidence.of(factor, models, models.parameters_of(unit)) for unit, factor in rows.items()}
        return cls(models, units, freqs_hz)

    @cached_property
    def usual(self) -> float:
        """Samples of the middle unit."""
        return float(np.median([e.n_samples for e in self.units.values()]))

    def response(self, evidence: Sequence[Evidence]) -> AnyArray:
        """Return responses of estimates, shape (estimate, frequency, n, m)."""
        sizes = np.sqrt([self.usual / e.n_samples for e in evidence])
        fitted = self.models.fit(np.stack([combine(e.lifted).R for e in evidence]) * sizes[:, None, None])
        return replace(self.models, A=fitted.A, B=fitted.B).responses(self.freqs_hz)

    def halves(self) -> tuple[AnyArray, AnyArray] | None:
        """Return the responses of all units from every second episode, and from the others."""
        several = [e for e in self.units.values() if len(e.factor.R) > 1]
        one, other = ([Evidence(e.factor[k::2], e.lifted[k::2]) for e in several] for k in (0, 1))
        return (self.response(one), self.response(other)) if several else None

    @property
    def _inputs(self) -> slice:
        """Columns of factors that are recorded inputs; functions of inputs are behind them."""
        first = self.models.lifting.n_states + len(self.models.lifting.separation.basis)
        return slice(first, first + len(self.models.recorded_inputs))

    def unlike(self, unit: str, titles: Sequence[str], factor: Factor) -> list[str]:
        """Return a sentence for every channel of a unit whose size or sign is not that of most units of the study."""
        channels = [*self.models.lifting.states, *self.models.recorded_inputs]
        units = {u: dict(enumerate(self._moments(e.factor))) for u, e in self.units.items()}
        texts = unlike(channels, units | {unit: dict(zip(titles, self._moments(factor), strict=True))})
        return [text for text in texts if text.startswith(tuple(f"{name}: " for name in (f"Unit {unit}", *titles)))]

    def _moments(self, factor: Factor) -> AnyArray:
        """Return second moments of channels, as `likeness.moments` of episodes of which no changes are known."""
        R = np.concatenate([factor.R[..., : self.models.lifting.n_states], factor.R[..., self._inputs]], axis=-1)
        return np.pad(R.mT @ R / factor.n_samples[:, None, None], ((0, 0), *2 * [(0, R.shape[-1])]))

    def same_motions(self, factor: Factor) -> bool:
        """Tell whether a unit was moved by inputs of the study alone."""
        inputs = self._inputs
        return _marks(factor, inputs) <= set().union(*(_marks(e.factor, inputs) for e in self.units.values()))

    def same_recordings(self, factor: Factor) -> set[str]:
        """Return units of the study that have an episode in common with some, by their factors."""
        marks = _marks(factor)
        return {unit for unit, e in self.units.items() if marks & _marks(e.factor)}

    def suffices(self, evidence: Evidence) -> bool:
        """Tell whether a unit was recorded for long enough to be compared with those of the study."""
        return evidence.n_samples >= OUTLIER.recorded * self.usual

    def qualified(self, score: OutlierScore, evidence: Evidence) -> OutlierScore:
        """Return what can be said about a unit: nothing where it was recorded for too little."""
        if self.suffices(evidence):
            return score
        more = OUTLIER.recorded * self.usual / evidence.n_samples
        return replace(score, outlier=False, status=Status.NOT_ENOUGH_DATA, more_data=more)


def _marks(factor: Factor, columns: slice = slice(None)) -> set[tuple[float, ...]]:
    """Return the number of samples and the norms of some columns, to eight digits, of every episode."""
    norms = np.linalg.norm(factor.R[..., columns], axis=-2)
    return {(int(n), *(float(f"{v:.8g}") for v in row)) for n, row in zip(factor.n_samples, norms, strict=True)}
