"""Where a channel comes from: the column of the recordings as they were made, and what preparation made of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Scaling:
    """From a column as recorded to a channel: ``channel[k] = factor * column[k + lag_samples]``, plus `offset`."""

    column: str | int | None  # name in the header, or number from 1; none where it differs between units
    factor: float = 1.0
    lag_samples: int = 0  # samples by which the column lagged behind the others
    offset: str = ""  # what was added in every episode, in words; empty where nothing was
    converted: float = 1.0  # the part of the factor that is in the files already, since recordings were converted


Scalings = Mapping[str, Scaling]


def scaling_of(scalings: Scalings, name: str) -> Scaling:
    """Return the scaling of a channel; one that nobody declared is the column of its name, as it is."""
    return scalings.get(name, Scaling(name))
