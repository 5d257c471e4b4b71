"""Models of resampled training episodes: which share of a residual finite recordings make.

factors of every episode --> EDMD models of the episodes drawn
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...identify import Factor, ModelSet
from ...identify.bootstrap import ModelSamples, bootstrap_edmd, episode_weights
from ...identify.factors import Ranges, lifted_factor
from ..engine.context import Context


def resampling(context: Context, name: str, units: list[str], draws: int = 60) -> Callable[[], ModelSamples]:
    """Return work that computes EDMD models of resampled training episodes in the condition that feeds synthesis."""
    models = context.identified.models(name)
    return partial(_edmd_samples, models, *episode_factor(context, models, units), units, draws)


def _edmd_samples(models: ModelSet, factor: Factor, counts: list[int], units: list[str], draws: int) -> ModelSamples:
    """Return EDMD models of drawn episodes, in the recordings' units."""
    assert models.alpha is not None
    ones = Ranges(np.ones_like(models.output_scale), np.ones_like(models.input_scale))
    ranges = models.ranges if models.alpha_in_ranges else ones
    triangles, weights = ranges.triangles(factor.R), episode_weights(counts, draws, 0)
    return _restored(bootstrap_edmd(triangles, models.lifting.n_lifted, models.alpha, weights, units), ranges)


def episode_factor(context: Context, models: ModelSet, units: list[str]) -> tuple[Factor, list[int]]:
    """Return the stored factors of ``[Psi | Theta_plus]``, (unit, episode), and the number of episodes by unit."""
    recorded = context.identified.factors[context.facts.identify_on]
    places = [recorded.rows_of(unit) for unit in units]
    counts = [len(rows) for rows in places]
    if min(counts) < 2:
        unit = units[int(np.argmin(counts))]
        raise DataError(f"Resampling: unit {unit} has {min(counts)} training episodes; at least two are needed.")
    R, peak, n_samples = (_by_unit(getattr(recorded.factor, key), places) for key in ("R", "peak", "n_samples"))
    lifted = context.identified.models(context.identified.edmd_kinds[0])
    parameters = {key: values[[lifted.index(u) for u in units]][:, None] for key, values in lifted.parameters.items()}
    return lifted_factor(Factor(R, peak, n_samples), context.lifting, parameters, models.lifting), counts


def _by_unit(values: npt.NDArray[Any], places: list[list[int]]) -> npt.NDArray[Any]:
    """Return rows of episodes as (unit, episode, ...), zero where a unit has fewer episodes."""
    padded = np.zeros((len(places), max(map(len, places)), *values.shape[1:]), dtype=values.dtype)
    for row, rows in enumerate(places):
        padded[row, : len(rows)] = values[rows]
    return padded


def _restored(samples: ModelSamples, ranges: Ranges) -> ModelSamples:
    """Return samples in the recordings' units, of channels divided by their ranges."""
    return replace(samples, estimate=ranges.restore(samples.estimate), samples=ranges.restore(samples.samples))
