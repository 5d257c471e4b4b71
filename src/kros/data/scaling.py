"""Where a channel comes from: the column of the recordings as they were made, and what preparation made of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Scaling:
    """From a column of the original recordings to a channel: ``channel[k] = factor * column[k + lag_samples]``, plus what `offset` says.

    Parameters
    ----------
    column : str or int, optional
        Name in the header, or number from 1; None where it differs between units.
    factor : float
    lag_samples : int
        Samples by which the column lagged behind the others.
    offset : str
        What was added in every episode, in words; empty where nothing was.
    """

    column: str | int | None
    factor: float = 1.0
    lag_samples: int = 0
    offset: str = ""


Scalings = Mapping[str, Scaling]


def scaling_of(scalings: Scalings, name: str) -> Scaling:
    """Return the scaling of a channel; one that nobody declared is the column of its name, as it is."""
    return scalings.get(name, Scaling(name))
