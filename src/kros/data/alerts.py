"""What looks wrong in recordings without making them unusable: said once, and shown with the results."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import permutations

import numpy as np
import numpy.typing as npt

from .population import Channel, Role

LONGEST_S, SHORTEST_S = 0.5, 1e-6  # sampling periods outside are rare for machines, and usual for a time in ms or us taken for seconds
_CORRELATED = 0.95  # of a channel with the slope of another one, from which on it counts as its derivative


def period_alerts(values: npt.NDArray[np.float64], channels: Sequence[Channel], period_s: float) -> tuple[str, ...]:
    """Return what speaks against a sampling period."""
    return (*_size(period_s), *_derivatives(values, channels, period_s), *_sampling(values, channels, period_s))


def _size(period_s: float) -> Iterator[str]:
    if not SHORTEST_S < period_s < LONGEST_S:
        yield (
            f"The sampling period of {period_s:g} s is unusual for a machine: check the unit of the column of time (time_scale) and sample_period_s, "
            "on which every frequency depends."
        )


def _derivatives(values: npt.NDArray[np.float64], channels: Sequence[Channel], period_s: float) -> Iterator[str]:
    """A state that is another one's slope, but for a factor of a thousand or a million: one of the units of time is another."""
    states = [i for i, c in enumerate(channels) if c.role is Role.STATE]
    for one, other in permutations(states, 2):
        slope, speed = (values[2:, one] - values[:-2, one]) / (2 * period_s), values[1:-1, other]
        sizes = np.linalg.norm(slope), np.linalg.norm(speed)
        if min(sizes) > 0 and slope @ speed > _CORRELATED * sizes[0] * sizes[1]:
            decades = np.log10(sizes[1] / sizes[0])
            if abs(abs(decades) - 3) < 0.05 or abs(abs(decades) - 6) < 0.05:
                yield (
                    f"{channels[other].name!r} is the slope of {channels[one].name!r} times {10.0 ** round(decades):g} at the sampling period of "
                    f"{period_s:g} s: check the unit of the column of time (time_scale), or the units of these channels."
                )


def _sampling(values: npt.NDArray[np.float64], channels: Sequence[Channel], period_s: float) -> Iterator[str]:
    """Signals that change by as much as their own size from sample to sample: sampled too slowly, or noise."""
    states = values[:, [i for i, c in enumerate(channels) if c.role is Role.STATE]]
    step, size = np.sqrt(np.mean(np.diff(states, axis=0) ** 2, axis=0)), states.std(axis=0)
    if np.all(step > size) and np.all(size > 0):
        yield (
            f"At the sampling period of {period_s:g} s every state changes by more than its own standard deviation from sample to sample: either "
            "they hold noise alone, or samples are too far apart for a model of one step."
        )
