"""Frequency responses of a study's models, every signal over its range."""

from __future__ import annotations

from typing import Any

import numpy.typing as npt

from ..identify import ModelSet

Array = npt.NDArray[Any]


def scaled_responses(models: ModelSet, units: list[str], freqs_hz: Array) -> Array:
    """Return frequency responses in units of the population's ranges, shape (unit, frequency, n, m)."""
    return models.normalised().systems(units).frequency_response(freqs_hz)
