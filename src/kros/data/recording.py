"""One episode as recorded: samples and, where there is one, a time column. Checks of time live here.

reader ── Recording ── steps ── Recording ── checks ── samples
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ..core import limits
from ..core.errors import DataError
from .population import EpisodeKey

Float = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CheckRule:
    """What recordings are refused for, and which sampling periods are doubted."""

    time: float = 1e-3  # largest deviation of one time step, in sampling periods
    period: float = 1e-4  # largest relative difference of the sampling periods of two episodes
    end: float = 1e-6  # of a sample: how far rounding may move the end of an even grid
    samples: int = 3  # fewest: two consecutive states and one more
    wild: float = 1e3  # times the size of a channel, from which on a sample is wild
    constant: float = 1e-12  # of the largest value: what filters and scales make of a constant
    # sampling periods outside are usual for a time in ms or us that is taken for seconds
    shortest_s: float = 1e-6
    longest_s: float = 0.5


CHECK = CheckRule()


@dataclass(frozen=True, eq=False)
class Recording:
    """One episode before or between preparation steps."""

    key: EpisodeKey
    values: Float  # shape (n_samples, n_channels)
    time_s: Float | None = None  # shape (n_samples,), s; None where the samples are known to be even

    def cut(self, start: int, stop: int) -> Recording:
        """Return samples `start` to `stop - 1`."""
        time = None if self.time_s is None else self.time_s[start:stop]
        return replace(self, values=self.values[start:stop], time_s=time)


@dataclass(frozen=True, eq=False)
class Recordings:
    """Episodes of a reader, read one at a time; a format overrides `read`. Can be pickled when `places` can."""

    places: Mapping[EpisodeKey, Any]  # where each episode is

    def read(self, key: EpisodeKey, place: Any) -> Recording:
        """Return one episode as recorded."""
        raise NotImplementedError

    def __call__(self, key: EpisodeKey) -> Recording:
        """Return one episode, without a last sample that repeats the stamp before it, as stopped recorders write."""
        if key not in self.places:
            others = f"this source has {len(self.places)} other episodes"
            raise DataError(f"Asked for {key}; {others}; take keys from population.episodes.")
        recording = self.read(key, self.places[key])
        time = recording.time_s
        repeated = time is not None and len(time) > 1 and time[-1] == time[-2]
        return recording.cut(0, len(recording.values) - 1) if repeated else recording

    def file(self, place: Any) -> Path | None:
        """Return the one file that an episode is in, where it is in one."""
        return None

    def restricted(self, keys: Iterable[EpisodeKey]) -> Self:
        """Return the same for fewer episodes, cheaper to send to another process."""
        return replace(self, places={key: self.places[key] for key in keys})


def usable(values: Float) -> npt.NDArray[np.bool_]:
    """Tell which samples are numbers of a size that can be computed with."""
    return np.asarray(np.abs(values) <= limits.MAX_VALUE)


def title(key: EpisodeKey) -> str:
    """Return how a message names an episode, for example ``Episode 7 of unit 001011 (load)``."""
    return f"E{str(key)[1:]}"


def some(names: Sequence[str], most: int = 8) -> str:
    """Return the first of some names for a message, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def estimate_period(recording: Recording) -> float:
    """Return the median time step, rounded to six digits so that 0.0010000000000000009 s reads 0.001 s."""
    name, time = title(recording.key), np.zeros(0) if recording.time_s is None else recording.time_s
    if len(time) < 2:
        need = "the sampling period needs at least two samples with time"
        raise DataError(f"{name}: {need}, found {len(time)}; leave the episode out.")
    steps = np.diff(time)
    shortest, longest = (float(f"{step:.6g}") for step in (steps.min(), steps.max()))
    period = shortest if shortest == longest else float(f"{np.median(steps):.6g}")  # rounding keeps order
    if not period > 0:
        advice = "name the column that holds time, in seconds and increasing"
        raise DataError(f"{name}: the median time step is {period:g} s; {advice}.")
    return period


def check_increasing(recording: Recording, where: str = "") -> None:
    """Refuse time that stands still, runs backwards or is not a number."""
    time = recording.time_s
    if time is None:
        return
    bad = np.flatnonzero(~(np.diff(time) > 0))
    if bad.size:
        k = int(bad[0])
        actual = f"found {time[k]:g} s at sample {k} and {time[k + 1]:g} s at sample {k + 1} ({len(bad)} such steps)"
        advice = "remove repeated or disordered samples"
        raise DataError(f"{title(recording.key)}{where}: time should increase, {actual}; {advice}.")


def check_even(recording: Recording, period_s: float, reference: EpisodeKey, where: str = "") -> None:
    """Check that an episode is sampled evenly, at the population's period."""
    time = recording.time_s
    if time is None or len(time) < 2:
        return
    check_increasing(recording, where)
    steps, period = np.diff(time), estimate_period(recording)
    deviation = np.abs(steps - period)
    worst = int(deviation.argmax())
    step = 'declare [[data.prepare]] step = "resample"'
    if deviation[worst] > CHECK.time * period:
        count = np.count_nonzero(deviation > CHECK.time * period)
        raise DataError(
            f"{title(recording.key)}{where}: uneven time, {count} of {len(steps)} steps differ from {period:g} s by "
            f"more than {CHECK.time:g} of it, the worst {steps[worst]:g} s at sample {worst}; {step}, "
            f"period_s = {period:.3g}, or fix the source."
        )
    mean = float((time[-1] - time[0]) / len(steps))
    if abs(mean - period_s) > max(CHECK.period, CHECK.time / len(steps)) * period_s:
        raise DataError(
            f"Two sampling periods: {period_s:g} s in {reference} and {period:g} s in {recording.key}{where}; a "
            f"population has one, {step}, period_s = {max(period, period_s):g}, or leave one out."
        )
