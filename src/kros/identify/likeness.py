"""Units and episodes with channels that are recorded otherwise than in most: in another unit, mirrored, or stuck."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core import ROUNDING, TINY, Array
from ..data.recording import CHECK


def moments(values: Array) -> Array:
    """Return the covariance of channels and their changes in an episode (n_samples, c), shape (2 c, 2 c)."""
    changes = np.diff(values, axis=0)
    return np.cov(np.hstack([values[1:], changes]).T, bias=True)


def course(values: Array) -> Array:
    """Return three numbers of every channel of an episode (n_samples, c), shape (3, c).

    They are the longest share of the episode in which it stays the same while another channel moves by half of its
    span, its largest change from one sample to the next, and the range of 98 % of its samples.
    """
    shares, far = np.zeros(values.shape[1]), np.ptp(values, axis=0) / 2
    for i, column in enumerate(values.T):
        ends = np.concatenate([[0], np.flatnonzero(np.diff(column)) + 1, [len(column)]])
        longest = int(np.diff(ends).argmax())
        part = values[ends[longest] : ends[longest + 1]]
        if (np.ptp(part, axis=0) > far).any():
            shares[i] = len(part) / len(values)
    low, high = np.quantile(values, (0.01, 0.99), axis=0)
    return np.array([shares, np.abs(np.diff(values, axis=0)).max(axis=0), high - low])


def odd(episodes: Sequence[str], channels: Sequence[str], courses: Array) -> list[str]:
    """Return a sentence for every state that stays the same, or jumps, unlike in most episodes, (episodes, 3, n)."""
    shares, jumps, spans = np.swapaxes(courses, 0, 1)
    held = (shares > CHECK.held) & (shares > CHECK.ratio * np.median(shares, axis=0))
    size = np.maximum(spans, np.median(spans, axis=0))
    found = [
        (i, k, f"stays the same for {100 * shares[i, k]:.0f} % of it while others move") for i, k in np.argwhere(held)
    ]
    far = np.argwhere((jumps > CHECK.jump * size) & (size > 0))
    found += [(i, k, f"jumps by {jumps[i, k] / size[i, k]:.3g} times its range between two samples") for i, k in far]
    return [f"{episodes[i]}: {channels[k]} {what}; if its sensor failed, leave it out." for i, k, what in found]


def unlike(units: Sequence[str], channels: Sequence[str], covariances: Sequence[Array]) -> list[str]:
    """Return a sentence for every channel of a unit whose size, or whose sign, is not that of most units."""
    G, c = np.array(covariances), len(channels)
    size = np.sqrt(np.maximum(np.diagonal(G, axis1=1, axis2=2), TINY))
    correlation = G / size[:, :, None] / size[:, None]
    moved = size[:, :c]
    most = np.median(moved, axis=0)
    ratio = moved / most
    log, far = np.log(ratio), np.log(CHECK.ratio)
    beside = log - np.median(log, axis=1, keepdims=True)  # other channels of the unit: it may have been moved less
    moves = np.minimum(moved, most) > ROUNDING * moved.max(axis=0)  # what rests has no unit of measure
    apart = moves & (np.abs(log) > far) & (np.abs(beside) > far / 2)
    sure = np.abs(correlation) > CHECK.correlation
    usual = np.median(correlation, axis=0)
    opposite = sure & (np.abs(usual) > CHECK.correlation) & (correlation * usual < 0)
    found = []
    for i, unit in enumerate(units):
        for k in np.flatnonzero(apart[i]).tolist():
            times = f"{channels[k]} moves {ratio[i, k]:.3g} times as much as in most units"
            found.append(f"Unit {unit}: {times}; check its unit of measure.")
        if opposite[i].any():
            name = channels[int(opposite[i].sum(axis=0).argmax()) % c]
            found.append(f"Unit {unit}: {name} moves against other channels, unlike in most units; check its sign.")
    return found
