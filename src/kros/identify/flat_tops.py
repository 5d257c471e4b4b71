"""Limits that show in recordings: a state that is cut off at one and the same extreme value, whatever the inputs are.

A flat top is a run of samples at a signal's extreme value, within its noise. It counts as a limit where the signal
comes from elsewhere (what rests at the start of an episode stands still, too) and changes sharply before or after (a
smooth peak falls with the square of the time), where it is there several times, in more than one episode, with nothing
beyond, and where every input took different values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..core.rounding import ITERATED
from ..data.population import Array, EpisodeKey

Rows = npt.NDArray[np.int64]


@dataclass(frozen=True)
class LimitRule:
    """When flat tops count as a limit."""

    shortest: int = 8  # samples of a run: as many as a filter of a sensor may smear
    runs: int = 5  # fewest runs
    episodes: int = 2  # in so many of which they are
    noise: float = 5.0  # standard deviations that noise is wide
    far: float = 5.0  # widths of the noise by which the signal falls beside a run
    varied: float = 0.02  # of an input's range that it covers in the runs


_RULE = LimitRule()


@dataclass(frozen=True, eq=False)
class FlatTops:
    """Flat tops of a state at one end of its range in one episode."""

    key: EpisodeKey
    top: float  # largest value of the signal, noise apart
    width: float  # of the noise
    # Of every run, shape (runs, 3 + m): mean, samples, whether the signal is far away shortly before or after, inputs.
    runs: Array


Ends = tuple[FlatTops, FlatTops]  # at the lower end with the sign changed, and at the upper end


@dataclass(frozen=True)
class FoundLimit:
    """Limits of a state that show in recordings."""

    lower: float | None
    upper: float | None  # in the recordings' unit; none at an end where there is none
    units: tuple[str, ...]  # units that were seen at them
    samples: int  # how long


def ends_of(key: EpisodeKey, signal: Array, inputs: Array) -> Ends:
    """Return the flat tops of a signal, shape (n_samples,), with inputs of shape (n_samples, m), at both ends."""
    signal, width = np.ascontiguousarray(signal), _width(signal)
    return _flat_tops(key, -signal, inputs, width), _flat_tops(key, signal, inputs, width)


def found_limit(ends: Sequence[Ends], ranges: Array) -> FoundLimit | None:
    """Return the limits that all episodes of a population speak for; None where they speak for none."""
    below, above = (_level(side, ranges) for side in zip(*ends, strict=True))
    if below is None and above is None:
        return None
    units = tuple(dict.fromkeys(unit for level in (below, above) if level for unit in level.units))
    low, high = None if below is None else -below.value, None if above is None else above.value
    return FoundLimit(low, high, units, sum(level.samples for level in (below, above) if level))


class _Level(NamedTuple):
    """A limit at one end."""

    value: float
    units: tuple[str, ...]
    samples: int


def _flat_tops(key: EpisodeKey, signal: Array, inputs: Array, width: float) -> FlatTops:
    """Return the flat tops of a signal at its upper end, with noise of a width, and how far the signal goes."""
    place = _RULE.shortest if len(signal) > 2 * _RULE.shortest else 1
    top = float(np.partition(signal, -place)[-place])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], signal >= top - width, [False]])))
    long = edges[1::2] - edges[::2] >= _RULE.shortest
    starts, stops = edges[::2][long], edges[1::2][long]
    far = top - _RULE.far * width
    arrived = np.minimum.accumulate(signal)[starts] < far
    steep = arrived & _steep(signal, starts, stops, far)
    columns = [_means(signal, starts, stops), stops - starts, steep, *(_means(u, starts, stops) for u in inputs.T)]
    return FlatTops(key, top, width, np.column_stack(columns).astype(float))


def _level(tops: Sequence[FlatTops], ranges: Array) -> _Level | None:
    """Return the upper limit that flat tops of a population speak for; None where they do not."""
    level = max((f.runs[f.runs[:, 2] > 0, 0].max() for f in tops if f.runs[:, 2].any()), default=-np.inf)
    near = [(f, f.runs[np.abs(f.runs[:, 0] - level) <= f.width]) for f in tops]
    near = [(f, runs) for f, runs in near if len(runs)]
    if not near or any(f.top > level + 2 * f.width for f in tops):
        return None
    values, lengths, steep, *inputs = np.concatenate([runs for _, runs in near]).T
    often = len(lengths) >= _RULE.runs and len({f.key for f, _ in near}) >= _RULE.episodes
    if not often or any(np.ptp(u) <= _RULE.varied * size for u, size in zip(inputs, ranges, strict=True)):
        return None
    value = float(np.average(values, weights=lengths * steep))
    return _Level(value, tuple(dict.fromkeys(f.key.unit for f, _ in near)), int(lengths.sum()))


def _width(signal: Array) -> float:
    """Width of the noise: five standard deviations by second differences, at least one step of quantisation."""
    steps = np.diff(signal)
    noise = 1.4826 * float(np.median(np.abs(np.diff(steps)))) / np.sqrt(6) if len(steps) > 1 else 0.0
    return max(_RULE.noise * noise, 1.01 * smallest_step(signal))


def smallest_step(signal: Array) -> float:
    """Return the smallest step between samples, the quantisation of a digital sensor; rounding where there is none."""
    steps, floor = np.abs(np.diff(signal)), ITERATED * float(np.abs(signal).max())
    smallest = float(np.where(steps > floor, steps, np.inf).min(initial=np.inf))
    return smallest if np.isfinite(smallest) else floor


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
