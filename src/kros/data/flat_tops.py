"""Limits that show in recordings: a state that is cut off at one and the same extreme value, whatever the inputs are.

A flat top is a run of samples at a signal's extreme value, within its noise. It may be a smooth peak, a plateau that was commanded, the top level
of a coarse signal, or a limit. It counts as a limit where

- the signal has many levels,
- a quarter of the run's length before or after it the signal is far away (a smooth peak is not: it falls with the square of the time),
- it does not bend: the middle of the run is no higher than its ends,
- it is there several times, in more than one episode, at the same value, and nothing was recorded beyond,
- every input took different values there: what an input holds at one value may be that input's doing.

So a limit that only shows under one and the same input is not found; it can be declared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
SHORTEST = 8  # samples of a run
_RUNS, _EPISODES = 5, 2
_LEVELS = 64  # fewer make a coarse signal, whose top level is no limit
_NOISE = 5.0  # standard deviations
_FAR = 5.0  # times the noise's width
_BENT = 0.25  # of this width
_VARIED = 0.02  # of an input's range


@dataclass(frozen=True, eq=False)
class FlatTops:
    """Flat tops of a state at one end of its range in one episode."""

    unit: str
    episode: str  # the episode's name holds its condition
    top: float  # largest value of the signal, noise apart
    width: float  # of the noise
    values: Array
    lengths: npt.NDArray[np.int64]  # samples of every run, of which `values` are the means
    sides: npt.NDArray[np.bool_]  # shape (runs, 2); whether the signal is far away shortly before and after
    bend: Array  # shape (runs,); by how much the middle is above the ends
    inputs: Array  # shape (runs, m); mean inputs


@dataclass(frozen=True)
class FoundLimit:
    """Limits of a state that were found."""

    lower: float | None
    upper: float | None  # in the recordings' unit; none at an end where there is none
    units: tuple[str, ...]  # units that were seen at them
    samples: int  # how long

    def __str__(self) -> str:
        ends = [f"{value:.4g}" for value in (self.lower, self.upper) if value is not None]
        return f"{' and '.join(ends)}, where {len(self.units)} units were for {self.samples} samples"


@dataclass(frozen=True, eq=False)
class Ends:
    """Flat tops of one state in one episode, at its lower end with the sign changed and at its upper end."""

    lower: FlatTops
    upper: FlatTops


def ends_of(unit: str, episode: str, signal: Array, inputs: Array) -> Ends:
    """Return the flat tops of a signal, shape (n_samples,), with inputs of shape (n_samples, m), at both ends."""
    signal, width = np.ascontiguousarray(signal), _width(signal)
    return Ends(flat_tops(unit, episode, -signal, inputs, width), flat_tops(unit, episode, signal, inputs, width))


def found_limit(found: Sequence[Ends], ranges: Array) -> FoundLimit | None:
    """Return the limits that all episodes of a population speak for; None where they speak for none."""
    below, above = [end.lower for end in found], [end.upper for end in found]
    lower, upper = limit_of(below, ranges), limit_of(above, ranges)
    lower = lower or _mirrored(upper, below)
    upper = upper or _mirrored(lower, above)
    if lower is None and upper is None:
        return None
    at = [part for part in (lower, upper) if part is not None]
    units = tuple(dict.fromkeys(unit for part in at for unit in part.units))
    values = [None if part is None else part.value for part in (lower, upper)]
    return FoundLimit(None if values[0] is None else -values[0], values[1], units, sum(part.samples for part in at))


@dataclass(frozen=True)
class _Level:
    """A limit at one end."""

    value: float
    units: tuple[str, ...]
    samples: int


def _mirrored(other: _Level | None, found: Sequence[FlatTops]) -> _Level | None:
    if other is None:
        return None
    furthest = max(found, key=lambda f: f.top)
    return _Level(other.value, (), 0) if abs(furthest.top - other.value) <= furthest.width else None


def flat_tops(unit: str, episode: str, signal: Array, inputs: Array, width: float) -> FlatTops:
    """Return the flat tops of a signal at its upper end, with noise of a width; without any it says how far the signal goes."""
    top = float(np.partition(signal, -SHORTEST)[-SHORTEST]) if len(signal) > 2 * SHORTEST else float(signal.max())
    near = signal >= top - width
    for _ in range(2):
        top = float(signal[near].mean())
        near = signal >= top - width
    there = np.concatenate([[False], near, [False]])
    edges = np.flatnonzero(there[1:] != there[:-1])
    starts, stops = edges[::2], edges[1::2]
    long = stops - starts >= SHORTEST
    starts, stops = starts[long], stops[long]
    if len(starts) and len(np.unique(signal[::_LEVELS])) < _LEVELS and len(np.unique(signal)) < _LEVELS:
        starts, stops = starts[:0], stops[:0]
    lengths = stops - starts
    means = [_means(c, starts, stops) for c in (signal, *inputs.T)]
    third = lengths // 3
    middle = _means(signal, starts + third, stops - third)
    return FlatTops(
        unit,
        episode,
        top,
        width,
        means[0],
        lengths,
        _sides(signal, starts, stops, top - _FAR * width),
        1.5 * (middle - means[0]),
        np.stack(means[1:], axis=1) if len(means) > 1 else np.zeros((len(starts), 0)),
    )


def limit_of(found: Sequence[FlatTops], ranges: Array) -> _Level | None:
    """Return the upper limit that flat tops of a population speak for; None where they do not."""
    cornered = [(f, f.sides.any(axis=1)) for f in found]
    levels = [f.values[ok].max() for f, ok in cornered if ok.any()]
    if not levels:
        return None
    level = max(levels)
    if any(f.top > level + 2 * f.width for f in found):
        return None
    at = [(f, np.abs(f.values - level) <= f.width) for f in found]
    at = [(f, rows) for f, rows in at if rows.any()]
    lengths, sides, bend, inputs = (
        np.concatenate([getattr(f, name)[rows] for f, rows in at]) for name in ("lengths", "sides", "bend", "inputs")
    )
    width = max(f.width for f, _ in at)
    varied = np.all(np.ptp(inputs, axis=0) > _VARIED * ranges)
    often = len(lengths) >= _RUNS and len({(f.unit, f.episode) for f, _ in at}) >= _EPISODES
    cut_off = (
        np.average(sides.any(axis=1), weights=lengths) >= 0.5
        and abs(np.average(bend, weights=lengths)) <= _BENT * width
    )
    if not (often and varied and cut_off):
        return None
    values = np.concatenate([f.values[rows] for f, rows in at])
    units = tuple(dict.fromkeys(f.unit for f, _ in at))
    return _Level(float(np.average(values, weights=lengths * sides.any(axis=1))), units, int(lengths.sum()))


def _width(signal: Array) -> float:
    """Width of the noise: five standard deviations by second differences, at least one step of quantisation."""
    steps = np.diff(signal)
    second = np.abs(np.diff(steps))
    floor = 1e-9 * float(np.abs(signal).max())
    np.abs(steps, out=steps)
    smallest = float(np.where(steps > floor, steps, np.inf).min(initial=np.inf))
    noise = 1.4826 * float(np.median(second)) / np.sqrt(6) if len(second) else 0.0
    return max(_NOISE * noise, 1.01 * smallest if np.isfinite(smallest) else floor)


def _means(signal: Array, starts: npt.NDArray[np.int64], stops: npt.NDArray[np.int64]) -> Array:
    """Return the means of a signal over runs that are in order and apart."""
    if not len(starts):
        return np.zeros(0)
    bounds = np.stack([starts, stops], axis=1).ravel()[:-1]
    return np.asarray(np.add.reduceat(signal[: stops[-1]], bounds)[::2] / (stops - starts))


def _sides(
    signal: Array, starts: npt.NDArray[np.int64], stops: npt.NDArray[np.int64], far: float
) -> npt.NDArray[np.bool_]:
    """Whether the signal is below a value a quarter of the run's length before and after it; unknown where an episode begins or ends."""
    away = np.maximum((stops - starts) // 4, 2)
    before, after = starts - away, stops - 1 + away
    inside = np.clip(np.stack([before, after], axis=1), 0, len(signal) - 1)
    known = np.stack([before >= 0, after < len(signal)], axis=1)
    return np.asarray(known & (signal[inside] < far))
