"""The guard of an observer: bounds of its states from what it does on training episodes, and how long its start takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ..loops.filtering import recursion
from ..observer import Guard, Observer, run_observers
from ..observer.screen import Screen
from .monitor import settling
from .validation import ValidationSet

Array = npt.NDArray[np.float64]
RANGES = 1.0  # by which estimates may leave what they and the recordings were in training, in ranges of the state


def guarded(observers: Sequence[Observer], data: Sequence[ValidationSet]) -> list[Observer]:
    """Return observers of one lifting with guards: what they do and what is recorded on training episodes, begun at their first sample and amid them."""
    n, q = observers[0].lifting.n_states, list(observers[0].measured)
    low, high = np.full((len(observers), n), np.inf), np.full((len(observers), n), -np.inf)
    largest = [np.zeros(o.controller.n_states) for o in observers]
    for part in data:
        batch, y = part.batch, part.measurements(q)
        for first in (0, len(y) // 2):
            x = run_observers(observers, y[first:], batch.inputs[first:], observers[0].own(batch.parameters))
            inside = (np.arange(first, len(y))[:, None] < batch.lengths)[..., None]
            low = np.minimum(low, x.min(axis=(1, 2), where=inside, initial=np.inf))
            high = np.maximum(high, x.max(axis=(1, 2), where=inside, initial=-np.inf))
            recorded, own = batch.states[first:], batch.states.shape[-1]
            low[:, :own] = np.minimum(low[:, :own], recorded.min(axis=(0, 1), where=inside, initial=np.inf))
            high[:, :own] = np.maximum(high[:, :own], recorded.max(axis=(0, 1), where=inside, initial=-np.inf))
            for i, o in enumerate(observers):
                nu = np.where(inside & np.isfinite(y[first:]), y[first:] - x[i][..., q], 0.0)
                states = recursion(o.controller.A, nu, np.zeros((nu.shape[1], o.controller.n_states)), o.controller.B)
                largest[i] = np.maximum(largest[i], np.abs(states).max(axis=(0, 1), initial=0.0))
    return [replace(o, guard=_guard(o, *sides)) for o, *sides in zip(observers, low, high, largest, strict=True)]


def _guard(observer: Observer, low: Array, high: Array, correction: Array) -> Guard | None:
    """The guard of one observer; none where it diverges in training. What a measurement may be, its estimate may be."""
    if not all(np.isfinite(side).all() for side in (low, high, correction)):
        return None
    room = RANGES * np.maximum(high - low, np.finfo(float).tiny)
    low, high, at = low - room, high + room, list(observer.measured)
    screen = Screen.of(observer).measured
    low[at], high[at] = np.minimum(low[at], screen.least), np.maximum(high[at], screen.most)
    return Guard(low, high, (1 + 2 * RANGES) * np.maximum(correction, np.finfo(float).tiny), settling(observer))
