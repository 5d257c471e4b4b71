"""An observer improved on training episodes, kept as it was where anything speaks against that."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError, KrosError
from ...data.population import EpisodeKey
from ...observer import Observer, relift_certificate
from ..certificates import DIVERGED, dropout_error_percent, scales_of
from ..task import DesignTask
from ..validation import ValidationSet, hidden_mean

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]


def tuned_where_better(
    task: DesignTask,
    data: ValidationSet,
    start: Observer,
    tune: Callable[[ValidationSet, Observer], Observer],
    settle: Callable[[ValidationSet, Observer], Observer] = lambda _, observer: observer,
    score: Callable[[ValidationSet, Sequence[Observer]], Array] | None = None,
) -> tuple[Observer, dict[str, Any]]:
    """Tune an observer on most training episodes, and return what is better on the others."""
    held = held_out(data.batch.keys)
    unseen = data.part([i for i in range(len(held)) if held[i]])
    first = data.part(
        [i for i, key in enumerate(data.batch.keys) if key.unit not in {k.unit for k in data.batch.keys[:i]}]
    )
    try:
        if all(held):
            raise DataError("tuning needs a second training episode, to be judged on.")
        tuned = tune(data.part([i for i in range(len(held)) if not held[i]]), start)
    except (KrosError, np.linalg.LinAlgError) as error:
        log.info("%s stays as it was: %s", task.name, error)
        return settle(first, start), {"tuned": False}
    pair = [start, tuned]
    errors = hidden_mean(unseen.percent_of_all(pair), start.measured) if score is None else score(unseen, pair)
    before, after = errors.tolist()
    without = dropout_error_percent([start, tuned], first)
    settled = settle(first, tuned)
    better = after <= before and bool(without[1] < DIVERGED or without[0] >= DIVERGED)
    kept = better and relift_certificate(settled, scales=scales_of([settled], first, task)[0], mismatch=False).certified
    facts = {"tuned": kept, "held_out_percent": {"before": before, "after": after}}
    return settled if kept else settle(first, start), facts


def held_out(keys: Sequence[EpisodeKey]) -> list[bool]:
    """Tell which episodes tuning does not see: the last one of every unit and condition, or every third where there is one of each."""
    last = {(key.unit, key.condition): i for i, key in enumerate(keys)}
    if len(last) == len(keys):
        period = min(3, len(keys))
        return [i % period == period - 1 for i in range(len(keys))]
    return [last[key.unit, key.condition] == i for i, key in enumerate(keys)]
