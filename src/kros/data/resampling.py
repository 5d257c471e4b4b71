"""Preparation steps that filter: to another sampling period, or to a derivative."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..core import limits
from ..core.errors import ConfigError, DataError
from .filters import lowpass, resample_even
from .population import Channel, Role
from .recording import Float1D, Recording, check_increasing, estimate_period, title
from .step import Step


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
        if not 0 < self.period_s < math.inf:
            raise ConfigError(f"Step 'resample' needs period_s > 0, found {self.period_s}; give the period in seconds.")
        if self.max_gap_s is not None and not self.max_gap_s > 0:
            raise ConfigError(
                f"Step 'resample' needs max_gap_s > 0, found {self.max_gap_s}; give the longest gap in seconds, or leave it out."
            )
        return self.period_s

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the recording on the new grid, which starts at its first sample."""
        time: Float1D = np.arange(len(recording.values), dtype=np.float64) * period_s if recording.time_s is None else recording.time_s
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
        count = (time[-1] - time[0]) / min(self.period_s, median)
        if count > limits.MAX_SAMPLES:
            raise DataError(
                f"{title(recording.key)}: resampling to period_s = {self.period_s:g} would make {count:g} samples of {len(time)}; correct the period."
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

    def period_after(self, period_s: float) -> float:
        """Return the sampling period, unchanged; the cut-off has to lie below half its inverse."""
        if not 0 < self.cutoff_hz < 0.5 / period_s:
            raise ConfigError(
                f"Step 'differentiate' needs a cutoff_hz above zero and below the Nyquist frequency of {0.5 / period_s:g} Hz, found {self.cutoff_hz}; "
                "correct it."
            )
        return period_s

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the recording with one more column."""
        (column,) = self.columns((self.channel,), channels)
        smooth = lowpass(recording.values[:, [column]], self.cutoff_hz * period_s)[:, 0]
        return replace(recording, values=np.insert(recording.values, self._position(channels), np.gradient(smooth, period_s), axis=1))

    @staticmethod
    def _position(channels: tuple[Channel, ...]) -> int:
        return sum(c.role is Role.STATE for c in channels)
