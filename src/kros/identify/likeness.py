"""Units and episodes with channels that are recorded otherwise than in most: in another unit, mirrored, or stuck."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..core import ROUNDING, TINY, Array
from ..data.recording import CHECK
from ..data.steps import longest_stretch


def moments(values: Array) -> Array:
    """Return the covariance of channels and their changes in an episode (n_samples, c), shape (2 c, 2 c)."""
    return np.cov(np.hstack([values[1:], np.diff(values, axis=0)]).T, bias=True)


def course(values: Array) -> Array:
    """Return five numbers of every channel of an episode (n_samples, c), shape (5, c).

    They are the longest share of the episode in which it stays the same while another channel moves by half of its
    span, its largest change from one sample to the next, between which values 98 % of its samples are, and its step.
    """
    shares, far = np.zeros(values.shape[1]), np.ptp(values, axis=0) / 2
    for i, column in enumerate(values.T):
        start, stop = longest_stretch(np.diff(column) != 0)
        part = values[start:stop]
        if (np.ptp(part, axis=0) > far).any():
            shares[i] = len(part) / len(values)
    changes, (low, high) = np.abs(np.diff(values, axis=0)), np.quantile(values, (0.01, 0.99), axis=0)
    return np.array([shares, changes.max(axis=0), low, high, np.quantile(changes, CHECK.step, axis=0)])


def odd(episodes: Sequence[str], channels: Sequence[str], courses: Array) -> list[str]:
    """Return a sentence for every state that stays the same, or jumps, unlike in most episodes, (episodes, 5, n).

    And for every state that jumps by a full turn in rad or deg.
    """
    shares, jumps, low, high, steps = np.swapaxes(courses, 0, 1)
    spans = high - low
    held = (shares > CHECK.held) & (shares > CHECK.ratio * np.median(shares, axis=0))
    size = np.maximum(spans, np.median(spans, axis=0))
    far, advice = (jumps > CHECK.jump * size) & (size > 0), "if its sensor failed, leave it out."
    texts = [
        f"{episodes[i]}: {channels[k]} stays the same for {100 * shares[i, k]:.0f} % of it while others move; {advice}"
        for i, k in np.argwhere(held)
    ]
    texts += [
        f"{episodes[i]}: {channels[k]} jumps by {jumps[i, k] / size[i, k]:.3g} times its range "
        f"between two samples; {advice}"
        for i, k in np.argwhere(far)
    ]
    turns = [(np.abs(jumps - turn) <= steps) & (steps < CHECK.turn * turn) for turn in (2 * np.pi, 360.0)]
    wrapped = np.any(turns, axis=0) & (spans <= jumps + steps)
    for channel, of in zip(channels, wrapped.T, strict=True):
        if of.any():
            where = f"{episodes[int(of.argmax())]}: {channel} jumps by a full turn, in {of.sum()} episodes"
            texts.append(f"{where}, as a wrapped angle; unwrap it first, as numpy.unwrap does.")
    return texts


def apart(channels: Sequence[str], units: Mapping[str, Array]) -> list[str]:
    """Return a sentence for every channel of a unit whose values are beyond those of all others, which are alike.

    Units have the courses of their episodes, (episode, 5, c).
    """
    lows = np.array([of[:, 2].min(axis=0) for of in units.values()])
    highs = np.array([of[:, 3].max(axis=0) for of in units.values()])
    low, high, found = np.median(lows, axis=0), np.median(highs, axis=0), list[str]()
    among = (lows <= high) & (highs >= low)  # what most units have
    for i, k in np.argwhere(~among & (2 * among.sum(axis=0) > len(lows)) & (high > low)):
        lowest, highest = np.delete(lows[:, k], i).min(), np.delete(highs[:, k], i).max()
        if lows[i, k] > highest or highs[i, k] < lowest:
            others = f"those of other units between {lowest:.4g} and {highest:.4g}"
            text = f"values between {lows[i, k]:.4g} and {highs[i, k]:.4g}, {others}"
            found.append(f"Unit {list(units)[i]}: {channels[k]} has {text}; check its column and unit of measure.")
    return found


def unlike(channels: Sequence[str], units: Mapping[str, Mapping[Any, Array]]) -> list[str]:
    """Return a sentence for every channel of a unit whose size, or whose sign, is not that of most units.

    Units have the moments of their episodes, by the titles of these. If it is so in some episodes, these are named.
    """
    covariances, c = [np.array(list(of.values())) for of in units.values()], len(channels)
    moved = np.array([_sizes(G.mean(axis=0))[:c] for G in covariances])
    most = np.median(moved, axis=0)
    ratio = moved / most
    log, far = np.log(ratio), np.log(CHECK.ratio)
    beside = log - np.median(log, axis=1, keepdims=True)  # other channels of the unit: it may have been moved less
    moves = np.minimum(moved, most) > ROUNDING * moved.max(axis=0)  # what rests has no unit of measure
    apart = moves & (np.abs(log) > far) & (np.abs(beside) > far / 2)
    found = []
    for i, ((unit, episodes), mirrored) in enumerate(zip(units.items(), _mirrored(covariances, c), strict=True)):
        for k in np.flatnonzero(apart[i]).tolist():
            times = dict(zip(episodes, _sizes(covariances[i])[:, k] / most[k], strict=True))
            sizes = {title: of for title, of in times.items() if abs(np.log(of)) > far}
            if not 0 < 2 * len(sizes) <= len(episodes):
                sizes = {f"Unit {unit}": ratio[i, k]}
            much = "times as much as in most units; check its column and unit of measure."
            found += [f"{what}: {channels[k]} moves {of:.3g} {much}" for what, of in sizes.items()]
        names = {e: " or ".join(channels[k] for k in of) for e, of in zip(episodes, mirrored, strict=True) if of}
        if 2 * len(names) > len(episodes):  # most of them: the unit's sensor
            names = {f"Unit {unit}": name for name in names.values()}
        against = "moves against the other channels, unlike in most; check its sign."
        found += [f"{what}: {name} {against}" for what, name in names.items()]
    return found


def _mirrored(units: Sequence[Array], c: int) -> list[list[list[int]]]:
    """Return the channels of every episode of units, (episode, 2 c, 2 c), whose correlations have mostly changed sign.

    Usual correlations count. A correlation is usual if it has the same sign in nearly all episodes of most units.
    """
    sizes = [_sizes(G) for G in units]
    least = np.median(np.concatenate(sizes), axis=0) / CHECK.ratio  # what moves less than that may be noise
    scales = [np.where(size > least, size, np.inf) for size in sizes]
    correlations = [G / scale[:, :, None] / scale[:, None] for G, scale in zip(units, scales, strict=True)]
    sign = np.sign(np.median([np.median(r, axis=0) for r in correlations], axis=0))
    signed = [r * sign for r in correlations]
    usual = np.median([(r > CHECK.correlation).mean(axis=0) for r in signed], axis=0) >= CHECK.usual
    usual &= np.tile(np.eye(c) == 0, (2, 2))  # of two channels
    channels = []
    for r in signed:
        changed = usual * ((r < -CHECK.correlation) * 1.0 - (r > CHECK.correlation))
        excess = changed.sum(axis=2).reshape(-1, 2, c).sum(axis=1)
        channels.append([np.flatnonzero((of > 0) & (of == of.max())).tolist() for of in excess])
    return channels


def _sizes(G: Array) -> Array:
    """Return the standard deviations of covariances (..., k, k), shape (..., k)."""
    return np.sqrt(np.maximum(np.linalg.diagonal(G), TINY))
