"""Models of resampled training episodes, from what the identify stage stored: how much of a residual is there because recordings end.

factors of every episode --> EDMD models of the episodes drawn
refined models and their information --> one step from them, for the episodes drawn
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...data.scaled import scale_population
from ...identify import Factor, KoopmanMatrices, ModelSamples, ModelSet, bootstrap_edmd, bootstrap_refined, episode_weights, lifted_factor
from ...identify.identify import refine_options
from ...identify.ranges import Ranges
from ...identify.refine.episodes import episode_normals
from ..engine.context import Context

Array = npt.NDArray[np.float64]

DRAWS = 60
_SEED = 0


def resampled_models(context: Context, name: str, units: list[str]) -> ModelSamples:
    """Return models of resampled training episodes, in the condition that feeds the synthesis.

    Parameters
    ----------
    context : Context
    name : str
        Kind of model.
    units : list of str

    Returns
    -------
    ModelSamples

    Raises
    ------
    DataError
        When a unit has fewer than two training episodes.
    IdentificationError
        When episodes that were drawn leave a model undetermined.
    """
    models = context.identified.models(name)
    if models.alpha is None:
        everyone = _refined_samples(context, models)
        return _chosen(everyone, [models.index(u) for u in units])
    factor, counts = episode_factor(context, models, units)
    ranges = models.ranges if models.alpha_in_ranges else Ranges(np.ones_like(models.output_scale), np.ones_like(models.input_scale))
    weights = episode_weights(counts, DRAWS, _SEED)
    return _restored(bootstrap_edmd(ranges.triangles(factor.R), models.lifting.n_lifted, models.alpha, weights, units), ranges)


def episode_factor(context: Context, models: ModelSet, units: list[str]) -> tuple[Factor, list[int]]:
    """Return the stored factors of ``[Psi | Theta_plus]``, batch (unit, episode), and every unit's number of episodes."""
    recorded = context.identified.factors[context.facts.identify_on]
    places = {unit: recorded.rows_of(unit) for unit in units}
    counts = [len(found) for found in places.values()]
    if min(counts) < 2:
        raise DataError(f"Resampling: unit {units[int(np.argmin(counts))]} has {min(counts)} training episodes; at least two are needed.")
    R, peak, n_samples = (_by_unit(getattr(recorded.factor, key), list(places.values()), max(counts)) for key in ("R", "peak", "n_samples"))
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


def _refined_samples(context: Context, models: ModelSet) -> ModelSamples:
    """Samples of all units that were refined together, in channels divided by their ranges as they were."""
    units, facts, ranges = list(models.unit_ids), context.facts, models.ranges
    refined = context.identified.refined[models.name].in_channels(ranges)
    factor, counts = episode_factor(context, models, units)
    population, lifting = scale_population(context.population, models.sizes), models.lifting.in_sizes(models.sizes)
    keys = {u: facts.keys("train", u, facts.identify_on) for u in units}
    pooled = np.array([u in facts.pooled for u in units])
    options = refine_options(context.config.identify)
    normal = episode_normals(refined, population, keys, lifting, models.parameters, ranges.factor(factor), options, pooled)
    weights = episode_weights(counts, DRAWS, _SEED)
    return _restored(bootstrap_refined(refined.units, refined.whitening, refined.information, normal, weights, units), ranges)


def _restored(samples: ModelSamples, ranges: Ranges) -> ModelSamples:
    """Samples in the recordings' units from those of channels divided by their ranges."""
    return replace(samples, estimate=ranges.restore(samples.estimate), samples=ranges.restore(samples.samples))


def _chosen(samples: ModelSamples, rows: list[int]) -> ModelSamples:
    estimate, drawn = (KoopmanMatrices(m.A[rows], m.B[rows]) for m in (samples.estimate, samples.samples))
    return replace(samples, unit_ids=tuple(samples.unit_ids[k] for k in rows), estimate=estimate, samples=drawn)
