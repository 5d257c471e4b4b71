"""Limits that show in recordings: a state that is cut off at one and the same extreme value, whatever the inputs are.

A flat top is a run of samples at a signal's extreme value, within its noise. It may be a smooth peak, a commanded
plateau, the top level of a coarse signal, or a limit. It counts as a limit where

- the signal has many levels,
- the signal is constant there and changes sharply before or after (a smooth peak falls with the square of the time),
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
Rows = npt.NDArray[np.int64]
_OF_RUNS = ("values", "lengths", "steep", "bend", "inputs")


@dataclass(frozen=True)
class LimitRule:
    """When flat tops count as a limit."""

    shortest: int = 8  # samples of a run: as many as a filter of a sensor may smear
    runs: int = 5  # fewest runs
    episodes: int = 2  # in so many of which they are
    levels: int = 64  # of a signal; fewer make a coarse one, whose top level is no limit
    noise: float = 5.0  # standard deviations that noise is wide
    far: float = 5.0  # widths of the noise by which the signal falls beside a run
    bent: float = 0.25  # width of the noise that the middle of a run may be above its ends
    varied: float = 0.02  # of an input's range that it covers in the runs


_RULE = LimitRule()


@dataclass(frozen=True, eq=False)
class FlatTops:
    """Flat tops of a state at one end of its range in one episode."""

    unit: str
    episode: str  # the episode's name holds its condition
    top: float  # largest value of the signal, noise apart
    width: float  # of the noise
    values: Array  # mean of every run
    lengths: Rows  # samples of every run
    steep: npt.NDArray[np.bool_]  # whether the signal is far away shortly before or after a run
    bend: Array  # by how much the middle of a run is above its ends
    inputs: Array  # mean inputs of every run, shape (runs, m)


@dataclass(frozen=True)
class FoundLimit:
    """Limits of a state that show in recordings."""

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
    return Ends(*(flat_tops(unit, episode, side, inputs, width) for side in (-signal, signal)))


def found_limit(ends: Sequence[Ends], ranges: Array) -> FoundLimit | None:
    """Return the limits that all episodes of a population speak for; None where they speak for none."""
    below, above = [end.lower for end in ends], [end.upper for end in ends]
    lower, upper = limit_of(below, ranges), limit_of(above, ranges)
    lower, upper = lower or _mirrored(upper, below), upper or _mirrored(lower, above)
    if lower is None and upper is None:
        return None
    levels = [part for part in (lower, upper) if part is not None]
    units = tuple(dict.fromkeys(unit for part in levels for unit in part.units))
    value = None if upper is None else upper.value
    return FoundLimit(None if lower is None else -lower.value, value, units, sum(part.samples for part in levels))


@dataclass(frozen=True)
class _Level:
    """A limit at one end."""

    value: float
    units: tuple[str, ...] = ()
    samples: int = 0


def _mirrored(other: _Level | None, tops: Sequence[FlatTops]) -> _Level | None:
    """Return the limit of the other end where the signal goes as far at this one."""
    furthest = max(tops, key=lambda f: f.top)
    return None if other is None or abs(furthest.top - other.value) > furthest.width else _Level(other.value)


def flat_tops(unit: str, episode: str, signal: Array, inputs: Array, width: float) -> FlatTops:
    """Return the flat tops of a signal at its upper end, with noise of a width, and how far the signal goes."""
    top = (
        float(np.partition(signal, -_RULE.shortest)[-_RULE.shortest])
        if len(signal) > 2 * _RULE.shortest
        else float(signal.max())
    )
    for _ in range(2):
        top = float(signal[signal >= top - width].mean())
    edges = np.flatnonzero(np.diff(np.concatenate([[False], signal >= top - width, [False]])))
    starts, stops = edges[::2], edges[1::2]
    coarse = len(np.unique(signal[:: _RULE.levels])) < _RULE.levels and len(np.unique(signal)) < _RULE.levels
    long = (stops - starts >= _RULE.shortest) & (not coarse)
    starts, stops = starts[long], stops[long]
    third = (stops - starts) // 3
    values, middle = _means(signal, starts, stops), _means(signal, starts + third, stops - third)
    mean_inputs = np.reshape([_means(u, starts, stops) for u in inputs.T], (inputs.shape[1], len(starts))).T
    steep = _steep(signal, starts, stops, top - _RULE.far * width)
    return FlatTops(unit, episode, top, width, values, stops - starts, steep, 1.5 * (middle - values), mean_inputs)


def limit_of(tops: Sequence[FlatTops], ranges: Array) -> _Level | None:
    """Return the upper limit that flat tops of a population speak for; None where they do not."""
    level = max((f.values[f.steep].max() for f in tops if f.steep.any()), default=-np.inf)
    at = [(f, np.abs(f.values - level) <= f.width) for f in tops]
    at = [(f, rows) for f, rows in at if rows.any()]
    if not at or any(f.top > level + 2 * f.width for f in tops):
        return None
    runs = (np.concatenate([getattr(f, name)[rows] for f, rows in at]) for name in _OF_RUNS)
    values, lengths, steep, bend, inputs = runs
    often = len(lengths) >= _RULE.runs and len({(f.unit, f.episode) for f, _ in at}) >= _RULE.episodes
    straight = abs(np.average(bend, weights=lengths)) <= _RULE.bent * max(f.width for f, _ in at)
    varied = np.all(np.ptp(inputs, axis=0) > _RULE.varied * ranges)
    if not (often and straight and varied and np.average(steep, weights=lengths) >= 0.5):
        return None
    units = tuple(dict.fromkeys(f.unit for f, _ in at))
    return _Level(float(np.average(values, weights=lengths * steep)), units, int(lengths.sum()))


def _width(signal: Array) -> float:
    """Width of the noise: five standard deviations by second differences, at least one step of quantisation."""
    steps = np.diff(signal)
    noise = 1.4826 * float(np.median(np.abs(np.diff(steps)))) / np.sqrt(6) if len(steps) > 1 else 0.0
    floor = 1e-9 * float(np.abs(signal).max())
    np.abs(steps, out=steps)
    smallest = float(np.where(steps > floor, steps, np.inf).min(initial=np.inf))
    return max(_RULE.noise * noise, 1.01 * smallest if np.isfinite(smallest) else floor)


def _means(signal: Array, starts: Rows, stops: Rows) -> Array:
    """Return the means of a signal over runs that are in order and apart."""
    if not len(starts):
        return np.zeros(0)
    bounds = np.stack([starts, stops], axis=1).ravel()[:-1]
    return np.asarray(np.add.reduceat(signal[: stops[-1]], bounds)[::2] / (stops - starts))


def _steep(signal: Array, starts: Rows, stops: Rows, far: float) -> npt.NDArray[np.bool_]:
    """Tell whether the signal is below a value a quarter of the run's length before or after it, within the episode."""
    away = np.maximum((stops - starts) // 4, 2)
    at = np.stack([starts - away, stops - 1 + away], axis=1)
    inside = np.clip(at, 0, len(signal) - 1)
    return np.asarray(((at == inside) & (signal[inside] < far)).any(axis=1))
