"""Estimates that outlier scores compare: equally regularised whatever was recorded, and how much each may be off.

    factors of episodes --brought to one number of samples--> EDMD --> response of a unit
    factors of the study's episodes --some of them drawn--> what that response may be off by, recorded as little

Tikhonov's alpha stands against a Gram matrix that grows with the recording: at one alpha a unit that was recorded less is drawn further towards
zero, which looks like another machine. For scores every unit counts as recorded as long as the middle one of the study.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ...identify import Factor, ModelSet, combine, lifted_factor
from ...identify.identified import EpisodeFactors
from .score import OutlierScore, Status

Array = npt.NDArray[Any]

DRAWS = 48
_SEED = 0
_SAME = 1e-9  # relative difference of the Gram matrices of one recording, read twice
_STEP = 1.25  # ratio of amounts of data that share their draws, scaled
_UNLIKELY = 0.99  # quantile beyond which a unit's own episodes scatter more than the study's


@dataclass(frozen=True, eq=False)
class Evidence:
    """Episodes that a unit is identified from.

    Parameters
    ----------
    factor : Factor
        Parameter-free, batch (episode,).
    lifted : ndarray, shape (episode, q, q)
        Factors of ``[Psi | Theta_plus]``.
    """

    factor: Factor
    lifted: Array

    @classmethod
    def of(cls, factor: Factor, models: ModelSet, parameters: Mapping[str, float]) -> Evidence:
        """Lift the factors of one unit's episodes."""
        values = {name: np.full(len(factor.R), parameters[name]) for name in models.lifting.parameters}
        return cls(factor, lifted_factor(factor, models.lifting, values, models.lifting).R)

    @property
    def n_samples(self) -> int:
        """Samples of all episodes."""
        return int(self.factor.n_samples.sum())

    def part(self, episodes: Sequence[int]) -> Evidence:
        """Return some of the episodes."""
        rows = list(episodes)
        f = self.factor
        return Evidence(Factor(f.R[rows], f.peak[rows], f.n_samples[rows]), self.lifted[rows])


@dataclass(frozen=True, eq=False)
class Recorded:
    """What a study recorded in one condition, and how estimates from it scatter.

    Parameters
    ----------
    models : ModelSet
        Of the kind that is scored.
    units : mapping of str to Evidence
        Training episodes of every unit of `models`.
    freqs_hz : ndarray, shape (frequency,), Hz
    """

    models: ModelSet
    units: Mapping[str, Evidence]
    freqs_hz: Array

    @classmethod
    def of(cls, factors: EpisodeFactors, models: ModelSet, freqs_hz: Array) -> Recorded:
        """Take the units of models from the factors of all training episodes of a condition."""
        f, units = factors.factor, {}
        for unit in models.unit_ids:
            own = factors.rows_of(unit)
            factor = Factor(f.R[own], f.peak[own], f.n_samples[own])
            units[unit] = Evidence.of(factor, models, {k: float(v[models.index(unit)]) for k, v in models.parameters.items()})
        return cls(models, units, freqs_hz)

    @cached_property
    def usual(self) -> float:
        """Samples of the middle unit."""
        return float(np.median([e.n_samples for e in self.units.values()]))

    @cached_property
    def shortest(self) -> int:
        """Samples of the shortest episode."""
        return min(int(e.factor.n_samples.min()) for e in self.units.values())

    def response(self, evidence: Sequence[Evidence]) -> Array:
        """Return responses of estimates, shape (estimate, frequency, n, m), each regularised as if it had the usual number of samples."""
        joined = [combine(Factor(e.lifted, e.factor.peak, e.factor.n_samples)).R * np.sqrt(self.usual / e.n_samples) for e in evidence]
        found = self.models.fit(np.stack(joined))
        return replace(self.models, unit_ids=tuple(map(str, range(len(joined)))), A=found.A, B=found.B).responses(self.freqs_hz)

    def deviations(self, evidence: Evidence) -> Array:
        """Return draws of what an estimate from some episodes may be off by, shape (draw, frequency, n, m).

        They are those of the study's units, recorded as little, scaled up where the unit's own episodes scatter clearly more.
        """
        draws = self._drawn(evidence.n_samples)
        own = len(evidence.lifted)
        if own < 2:
            return draws
        from scipy.special import gammaincinv  # half a quantile of chi-squared, whose own module takes a second to load

        without = self.response([evidence.part(np.delete(np.arange(own), k).tolist()) for k in range(own)])
        jackknife = (own - 1) / own * (np.abs(without - without.mean(axis=0)) ** 2).sum(axis=0)
        usual = (np.abs(draws) ** 2).mean(axis=0)
        known = usual > 0
        ratio = float(np.median(jackknife[known] / usual[known])) if known.any() else 1.0
        clearly = ratio > 2 * gammaincinv((own - 1) / 2, _UNLIKELY) / (own - 1)
        return draws * np.sqrt(ratio) if clearly else draws

    def all_deviations(self) -> Sequence[Array]:
        """Return the deviations of all units of the study, each computed when it is asked for."""
        return _Deviations(self, list(self.units.values()))

    def qualified(self, score: OutlierScore, evidence: Evidence) -> OutlierScore:
        """Return what can be said about a unit; nothing where it was recorded for less than any episode of the study, of which none can be drawn."""
        if _STEP * evidence.n_samples >= self.shortest:
            return score
        more = max(score.more_data, self.shortest / evidence.n_samples)
        score_db = min(score.score_db, score.threshold_db)
        return replace(score, score_db=score_db, outlier=False, status=Status.NOT_ENOUGH_DATA, more_data=more)

    def same_recordings(self, factor: Factor) -> set[str]:
        """Return units of the study that have an episode in common with some, by their factors."""
        return {unit for unit, e in self.units.items() if any(_alike(e.factor, factor, k) for k in range(len(factor.R)))}

    def _drawn(self, n_samples: int) -> Array:
        """Draws for a number of samples, scaled from those of a number close to it: errors fall with the root of the samples."""
        nearest = _STEP ** round(np.log(n_samples) / np.log(_STEP))
        if nearest not in self._pools:
            self._pools[nearest] = self._pool(nearest)
        return self._pools[nearest] * np.sqrt(nearest / n_samples)

    @cached_property
    def _pools(self) -> dict[float, Array]:
        return {}

    @cached_property
    def _whole(self) -> dict[str, Array]:
        return dict(zip(self.units, self.response(list(self.units.values())), strict=True))

    def _pool(self, n_samples: float) -> Array:
        """Estimates from some of a unit's episodes minus that from all; what differs between units where each has one episode only."""
        several = [unit for unit, e in self.units.items() if len(e.lifted) > 1]
        if not several:
            return self._between(n_samples)
        rng, parts, scales, whole = np.random.default_rng(_SEED), [], [], []
        for draw in range(DRAWS):
            unit = several[draw % len(several)]
            e = self.units[unit]
            order = rng.permutation(len(e.lifted))
            sizes = e.factor.n_samples[order].cumsum()
            count = max(1, min(len(order) // 2, int(np.searchsorted(sizes, n_samples * (1 - _SAME))) + 1))
            parts.append(e.part(order[:count].tolist()))
            scales.append(np.sqrt((1 / n_samples) / (1 / sizes[count - 1] - 1 / sizes[-1])))
            whole.append(self._whole[unit])
        return np.asarray((self.response(parts) - np.stack(whole)) * np.array(scales)[:, None, None, None])

    def _between(self, n_samples: float) -> Array:
        """Differences between units, which are estimation errors of both and more: a bound where nothing else is known."""
        everyone = np.stack(list(self._whole.values()))
        sizes = np.array([e.n_samples for e in self.units.values()])
        apart = (everyone - np.roll(everyone, 1, axis=0)) / np.sqrt(2)
        return np.asarray(apart * np.sqrt(sizes / n_samples)[:, None, None, None])


@dataclass(frozen=True, eq=False)
class _Deviations(Sequence[Array]):
    recorded: Recorded
    evidence: Sequence[Evidence]

    def __len__(self) -> int:
        return len(self.evidence)

    def __getitem__(self, k: Any) -> Any:
        return self.recorded.deviations(self.evidence[k])


def _alike(stored: Factor, found: Factor, row: int) -> bool:
    """Tell whether an episode is among stored ones: equal length and equal Gram matrix, but for rounding."""
    candidates = np.flatnonzero(stored.n_samples == found.n_samples[row])
    gram = found.R[row].T @ found.R[row]
    size = np.sqrt(np.diag(gram))
    return any((np.abs(R.T @ R - gram) <= _SAME * np.outer(size, size)).all() for R in stored.R[candidates])
