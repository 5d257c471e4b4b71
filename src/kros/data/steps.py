"""Preparation as declared steps: small frozen objects, applied to each episode in the order given.

Each step tells what it does to the channels and the sampling period (`channels_after`, `period_after`), so that a population
can be described before anything is read, and does it to one recording at a time (`apply`). No step changes its argument.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..core.errors import ConfigError, DataError
from .filters import lowpass, resample_even
from .population import Channel, Role
from .recording import Recording, check_increasing, estimate_period, title


@dataclass(frozen=True)
class Step:
    """Base of all steps; `step` is the word that selects one in TOML."""

    step: ClassVar[str] = ""

    def channels_after(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels as this step leaves them."""
        return channels

    def period_after(self, period_s: float) -> float:
        """Return the sampling period as this step leaves it, s."""
        return period_s

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the prepared recording; `channels` and `period_s` describe the one given."""
        raise NotImplementedError

    def columns(self, names: Sequence[str], channels: tuple[Channel, ...]) -> list[int]:
        """Return the columns of named channels, or say which name is unknown."""
        known = [c.name for c in channels]
        for name in names:
            if name not in known:
                raise ConfigError(f"Step {self.step!r} asks for channel {name!r}; there are {known}; correct the name.")
        return [known.index(name) for name in names]


@dataclass(frozen=True)
class Scale(Step):
    """Multiply channels by a factor; `unit` names the new unit of measure."""

    channels: tuple[str, ...]
    factor: float
    unit: str | None = None
    step: ClassVar[str] = "scale"

    def channels_after(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels with their new unit of measure."""
        self.columns(self.channels, channels)
        return channels if self.unit is None else tuple(replace(c, unit=self.unit) if c.name in self.channels else c for c in channels)

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the recording with some columns multiplied."""
        values = recording.values.copy()
        for column in self.columns(self.channels, channels):
            values[:, column] *= self.factor
        return replace(recording, values=values)


@dataclass(frozen=True)
class Shift(Step):
    """Move channels that lag the others by `lag` samples back into place.

    The value recorded at sample ``k + lag`` is moved to sample ``k``; the ends that have no partner are cut. A negative `lag`
    moves channels that run ahead.
    """

    channels: tuple[str, ...]
    lag: int
    step: ClassVar[str] = "shift"

    def channels_after(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels, unchanged."""
        self.columns(self.channels, channels)
        return channels

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the aligned recording, `abs(lag)` samples shorter."""
        n, lag = len(recording.values), self.lag
        if n <= abs(lag):
            raise DataError(f"{title(recording.key)}: shifting by {lag} samples leaves nothing of {n}; leave the episode out.")
        length = n - abs(lag)
        fixed, moved = max(0, -lag), max(0, lag)
        values = recording.values[fixed : fixed + length].copy()
        for column in self.columns(self.channels, channels):
            values[:, column] = recording.values[moved : moved + length, column]
        return replace(recording, values=values, time_s=None if recording.time_s is None else recording.time_s[fixed : fixed + length])


@dataclass(frozen=True)
class Offset(Step):
    """Remove a channel's constant offset: ``channel += mean(reference - channel)`` over samples ``[start, stop)`` of each episode."""

    channel: str
    reference: str
    start: int
    stop: int
    step: ClassVar[str] = "offset"

    def channels_after(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels, unchanged."""
        self.columns((self.channel, self.reference), channels)
        if not 0 <= self.start < self.stop:
            raise ConfigError(f"Step 'offset' needs 0 <= start < stop, found start = {self.start}, stop = {self.stop}; correct the window.")
        return channels

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the recording with the offset removed."""
        column, reference = self.columns((self.channel, self.reference), channels)
        if len(recording.values) < self.stop:
            raise DataError(
                f"{title(recording.key)}: the offset of {self.channel!r} is calibrated over samples {self.start}-{self.stop - 1}, the episode has "
                f"{len(recording.values)}; leave the episode out."
            )
        window = recording.values[self.start : self.stop]
        values = recording.values.copy()
        values[:, column] += np.mean(window[:, reference] - window[:, column])
        return replace(recording, values=values)


@dataclass(frozen=True)
class Trim(Step):
    """Keep samples ``[start, stop)``, without the last `tail`."""

    start: int = 0
    stop: int | None = None
    tail: int = 0
    step: ClassVar[str] = "trim"

    def channels_after(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels, unchanged."""
        if self.start < 0 or self.tail < 0 or (self.stop is not None and self.stop <= self.start):
            raise ConfigError(f"Step 'trim' needs 0 <= start < stop and tail >= 0, found {self}; correct it.")
        return channels

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the shorter recording."""
        n = len(recording.values)
        stop = min(n if self.stop is None else self.stop, n - self.tail)
        if stop <= self.start:
            raise DataError(
                f"{title(recording.key)}: trimming to start = {self.start}, stop = {self.stop}, tail = {self.tail} leaves nothing of {n} samples; "
                "leave the episode out or trim less."
            )
        keep = slice(self.start, stop)
        return replace(recording, values=recording.values[keep], time_s=None if recording.time_s is None else recording.time_s[keep])


@dataclass(frozen=True)
class Resample(Step):
    """Bring uneven time, or another rate, to a fixed period.

    All channels are treated alike, so linear relations between them survive. At the same or a higher rate this is linear interpolation.
    When the rate falls, the samples are interpolated to a grid that is an integer number of times finer, filtered without delay below the
    new Nyquist frequency, and thinned. A gap longer than `max_gap_s` (default: ten median steps) is an error rather than a straight line.
    """

    period_s: float
    max_gap_s: float | None = None
    step: ClassVar[str] = "resample"

    def period_after(self, period_s: float) -> float:
        """Return the new sampling period, s."""
        if not self.period_s > 0:
            raise ConfigError(f"Step 'resample' needs period_s > 0, found {self.period_s}; give the period in seconds.")
        return self.period_s

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the recording on the new grid, which starts at its first sample."""
        time = np.arange(len(recording.values)) * period_s if recording.time_s is None else recording.time_s
        timed = replace(recording, time_s=time)
        check_increasing(timed)
        median = estimate_period(timed)
        gap = int(np.diff(time).argmax())
        longest, limit = time[gap + 1] - time[gap], 10 * median if self.max_gap_s is None else self.max_gap_s
        if longest > limit:
            raise DataError(
                f"{title(recording.key)}: resampling would bridge a gap of {longest:g} s after sample {gap} (allowed: {limit:g} s); "
                "cut the episode there, or raise max_gap_s."
            )
        return replace(recording, values=resample_even(time, recording.values, median, self.period_s), time_s=None)


@dataclass(frozen=True)
class Differentiate(Step):
    """Add the filtered derivative of a channel as a new state.

    Central differences after a low-pass filter without delay: it looks ahead, so the result is for identification and evaluation,
    never something a running observer could have measured.
    """

    channel: str
    name: str
    cutoff_hz: float
    unit: str = ""
    step: ClassVar[str] = "differentiate"

    def channels_after(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels with the new state after the other states."""
        self.columns((self.channel,), channels)
        if self.name in [c.name for c in channels]:
            raise ConfigError(f"Step 'differentiate' would add {self.name!r}, which is there already; choose another name.")
        at = self._position(channels)
        return (*channels[:at], Channel(self.name, Role.STATE, self.unit), *channels[at:])

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the recording with one more column."""
        (column,) = self.columns((self.channel,), channels)
        smooth = lowpass(recording.values[:, [column]], self.cutoff_hz * period_s)[:, 0]
        return replace(recording, values=np.insert(recording.values, self._position(channels), np.gradient(smooth, period_s), axis=1))

    @staticmethod
    def _position(channels: tuple[Channel, ...]) -> int:
        return sum(c.role is Role.STATE for c in channels)
