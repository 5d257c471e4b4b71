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

TIME_TOLERANCE = 1e-3  # largest deviation of one time step, in sampling periods
PERIOD_TOLERANCE = 1e-4  # largest relative difference of the sampling periods of two episodes

Float = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Recording:
    """One episode before or between preparation steps."""

    key: EpisodeKey
    values: Float  # shape (n_samples, n_channels)
    time_s: Float | None = None  # shape (n_samples,), s; None where the samples are known to be even


@dataclass(frozen=True, eq=False)
class Recordings:
    """Episodes as a reader found them, read one at a time; what reads a format overrides `read`. Can be pickled when `places` can."""

    places: Mapping[EpisodeKey, Any]  # where each episode is

    def read(self, key: EpisodeKey, place: Any) -> Recording:
        """Return one episode as recorded."""
        raise NotImplementedError

    def __call__(self, key: EpisodeKey) -> Recording:
        """Return one episode, or say that this source does not have it."""
        if key not in self.places:
            raise DataError(
                f"Asked for {key}; this source has {len(self.places)} other episodes; take keys from population.episodes."
            )
        return without_repeated_end(self.read(key, self.places[key]))

    def where(self, key: EpisodeKey) -> str:
        """Return in which file an episode is, for messages; nothing where it is in none."""
        file = self.file(self.places[key])
        return "" if file is None else f" in {file}"

    def file(self, place: Any) -> Path | None:
        """Return the one file that an episode is in; None where it is in none, or cannot be told."""
        return None

    def restricted(self, keys: Iterable[EpisodeKey]) -> Self:
        """Return the same for fewer episodes, cheaper to send to another process."""
        return replace(self, places={key: self.places[key] for key in keys})


def without_repeated_end(recording: Recording) -> Recording:
    """Drop the last sample where it repeats the stamp before it, as recorders write when they are stopped."""
    time = recording.time_s
    if time is None or len(time) < 2 or time[-1] != time[-2]:
        return recording
    return replace(recording, values=recording.values[:-1], time_s=time[:-1])


def usable(values: Float) -> npt.NDArray[np.bool_]:
    """Tell which samples are numbers of a size that can be computed with."""
    return np.asarray(np.abs(values) <= limits.MAX_VALUE)


def title(key: EpisodeKey) -> str:
    """Return how a message names an episode, for example ``Episode 7 of unit 001011 (load)``."""
    return f"E{str(key)[1:]}"


def some(names: Sequence[str], most: int = 4) -> str:
    """Return the first of some names for a message, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def estimate_period(recording: Recording) -> float:
    """Return the median time step, rounded to six digits so that 0.0010000000000000009 s reads 0.001 s."""
    time = recording.time_s
    if time is None or len(time) < 2:
        found = 0 if time is None else len(time)
        raise DataError(
            f"{title(recording.key)}: the sampling period needs at least two samples with time, found {found}; leave the episode out."
        )
    steps = np.diff(time)
    shortest, longest = _six_digits(steps.min()), _six_digits(steps.max())
    period = shortest if shortest == longest else _six_digits(np.median(steps))  # rounding keeps order
    if not period > 0:
        raise DataError(
            f"{title(recording.key)}: the median time step is {period:g} s; name the column that holds time, in seconds and increasing."
        )
    return period


def _six_digits(number: float) -> float:
    return float(f"{number:.6g}")


def check_increasing(recording: Recording, where: str = "") -> None:
    """Refuse time that stands still, runs backwards or is not a number."""
    time = recording.time_s
    if time is None:
        return
    bad = np.flatnonzero(~(np.diff(time) > 0))
    if bad.size:
        k = int(bad[0])
        raise DataError(
            f"{title(recording.key)}{where}: time should increase, found {time[k]:g} s at sample {k} and {time[k + 1]:g} s at sample {k + 1} "
            f"({bad.size} such steps); remove repeated or disordered samples."
        )


def check_even(recording: Recording, period_s: float, reference: EpisodeKey, where: str = "") -> None:
    """Check that an episode is sampled evenly, at the population's period."""
    time = recording.time_s
    if time is None or len(time) < 2:
        return
    check_increasing(recording, where)
    steps = np.diff(time)
    own = estimate_period(recording)
    deviation = np.abs(steps - own)
    worst = int(deviation.argmax())
    if deviation[worst] > TIME_TOLERANCE * own:
        count = int(np.count_nonzero(deviation > TIME_TOLERANCE * own))
        raise DataError(
            f"{title(recording.key)}{where}: uneven time, {count} of {len(steps)} steps differ from {own:g} s by more than "
            f"{TIME_TOLERANCE:g} of it, the worst "
            f'{steps[worst]:g} s at sample {worst}; declare [[data.prepare]] step = "resample", period_s = {own:.3g}, or fix the source.'
        )
    mean = float((time[-1] - time[0]) / len(steps))
    if abs(mean - period_s) > max(PERIOD_TOLERANCE, TIME_TOLERANCE / len(steps)) * period_s:
        raise DataError(
            f"Two sampling periods: {period_s:g} s in {reference} and {own:g} s in {recording.key}{where}; a population has one, "
            f'declare [[data.prepare]] step = "resample", period_s = {max(own, period_s):g}, or leave one out.'
        )
