"""Models of resampled training episodes, from what the identify stage stored: how much of a residual is there because recordings end.

factors of every episode --> EDMD models of the episodes drawn
refined models and their information --> one step from them, for the episodes drawn
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...identify import Factor, KoopmanMatrices, ModelSamples, ModelSet, bootstrap_edmd, episode_weights
from ...identify.bootstrap import bootstrap_refined
from ...identify.factors import Ranges, lifted_factor
from ...identify.refine import Refinement, RefineOptions
from ...identify.refine.episodes import episode_normals
from ...identify.refine.model import TrainingData
from ..engine.context import Context

DRAWS = 60
_SEED = 0


def resampling(context: Context, name: str, units: list[str]) -> Callable[[], ModelSamples]:
    """Return what computes models of resampled training episodes, in the condition that feeds synthesis, in a process of its own."""
    models = context.identified.models(name)
    if models.alpha is None:
        return partial(_refined_samples, _refined_models(context, models), tuple(models.index(u) for u in units))
    factor, counts = episode_factor(context, models, units)
    return partial(_edmd_samples, models, factor, counts, units)


def _edmd_samples(models: ModelSet, factor: Factor, counts: list[int], units: list[str]) -> ModelSamples:
    assert models.alpha is not None
    ranges = (
        models.ranges
        if models.alpha_in_ranges
        else Ranges(np.ones_like(models.output_scale), np.ones_like(models.input_scale))
    )
    weights = episode_weights(counts, DRAWS, _SEED)
    return _restored(
        bootstrap_edmd(ranges.triangles(factor.R), models.lifting.n_lifted, models.alpha, weights, units), ranges
    )


def episode_factor(context: Context, models: ModelSet, units: list[str]) -> tuple[Factor, list[int]]:
    """Return the stored factors of ``[Psi | Theta_plus]``, batch (unit, episode), and every unit's number of episodes."""
    recorded = context.identified.factors[context.facts.identify_on]
    places = {unit: recorded.rows_of(unit) for unit in units}
    counts = [len(found) for found in places.values()]
    if min(counts) < 2:
        raise DataError(
            f"Resampling: unit {units[int(np.argmin(counts))]} has {min(counts)} training episodes; at least two are needed."
        )
    R, peak, n_samples = (
        _by_unit(getattr(recorded.factor, key), list(places.values()), max(counts))
        for key in ("R", "peak", "n_samples")
    )
    whole = Factor(R, peak, n_samples)
    lifted = context.identified.models(context.identified.edmd_kinds[0])
    parameters = {key: values[[lifted.index(u) for u in units]][:, None] for key, values in lifted.parameters.items()}
    return lifted_factor(whole, context.lifting, parameters, models.lifting), counts


def _by_unit(values: npt.NDArray[Any], places: list[list[int]], most: int) -> npt.NDArray[Any]:
    """Rows of episodes as (unit, episode, ...), zero where a unit has fewer episodes."""
    found = np.zeros((len(places), most, *values.shape[1:]), dtype=values.dtype)
    for row, own in enumerate(places):
        found[row, : len(own)] = values[own]
    return found


@dataclass(frozen=True, eq=False)
class _Refined:
    """Models that were refined together and what they were refined on, in channels divided by their ranges as they were."""

    models: KoopmanMatrices
    refinement: Refinement
    data: TrainingData
    ranges: Ranges
    counts: list[int]


def _refined_models(context: Context, models: ModelSet) -> _Refined:
    units, facts, ranges = list(models.unit_ids), context.facts, models.ranges
    factor, counts = episode_factor(context, models, units)
    keys = {u: tuple(facts.keys("train", u, facts.identify_on)) for u in units}
    pooled = np.array([u in facts.pooled for u in units])
    recorded = context.population.select(units, [facts.identify_on])
    data = TrainingData(recorded, keys, models.lifting, dict(models.parameters), factor, pooled).divided_by(ranges)
    matrices = ranges.normalise(KoopmanMatrices(models.A, models.B))
    return _Refined(matrices, context.identified.refined[models.name].divided_by(ranges), data, ranges, counts)


def _refined_samples(of: _Refined, rows: Sequence[int]) -> ModelSamples:
    """Samples of some of the units, in the recordings' units of measure."""
    normal = episode_normals(of.models, of.refinement, of.data, RefineOptions())
    weights, T, H = episode_weights(of.counts, DRAWS, _SEED), of.refinement.whitening, of.refinement.information
    return _chosen(_restored(bootstrap_refined(of.models, T, H, normal, weights, list(of.data.keys)), of.ranges), rows)


def _restored(samples: ModelSamples, ranges: Ranges) -> ModelSamples:
    """Samples in the recordings' units from those of channels divided by their ranges."""
    return replace(samples, estimate=ranges.restore(samples.estimate), samples=ranges.restore(samples.samples))


def _chosen(samples: ModelSamples, rows: Sequence[int]) -> ModelSamples:
    estimate, drawn = (KoopmanMatrices(m.A[list(rows)], m.B[list(rows)]) for m in (samples.estimate, samples.samples))
    return replace(samples, unit_ids=tuple(samples.unit_ids[k] for k in rows), estimate=estimate, samples=drawn)
