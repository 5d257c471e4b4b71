"""Preparation steps that filter: to another sampling period, or to a derivative. Filters have no delay, so they look ahead."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from ...core import limits
from ...core.errors import ConfigError, DataError
from ..population import Channel, Role
from ..recording import Recording, check_increasing, estimate_period, title
from ..scaling import Scalings, scaling_of
from .step import Step

Float = npt.NDArray[np.float64]

_DIRECT = 2000  # half length from which on convolution by FFT is faster by orders
PASSBAND = 0.8  # cutoff of the anti-alias filter as a share of the new Nyquist frequency


def lowpass(values: Float, cutoff: float) -> Float:
    """Filter columns without delay by a windowed sinc; ends are extended by odd reflection, shape (n_samples, n_channels)."""
    n = len(values)
    half = min(math.ceil(4 / cutoff), n - 1) if cutoff > 0 else 0
    if cutoff >= 0.5 or half < 1:
        return values
    k = np.arange(-half, half + 1)
    taps = np.sinc(2 * cutoff * k) * np.hamming(2 * half + 1)
    taps /= taps.sum()
    padded = np.concatenate([2 * values[0] - values[half:0:-1], values, 2 * values[-1] - values[-2 : -half - 2 : -1]])
    if half > _DIRECT:
        from scipy.signal import fftconvolve

        return np.column_stack([fftconvolve(column, taps, mode="valid") for column in padded.T])
    return np.column_stack([np.convolve(column, taps, mode="valid") for column in padded.T])


def resample_even(time_s: Float, values: Float, median_s: float, period_s: float) -> Float:
    """Bring samples at increasing times to an even grid from the first time on, shape (n_new, n_channels)."""
    finer = math.ceil(period_s / median_s - 1e-3)
    step = period_s / finer
    count = math.floor((time_s[-1] - time_s[0]) / step + 1e-6) + 1
    grid = time_s[0] + step * np.arange(count)
    fine = np.column_stack([np.interp(grid, time_s, column) for column in values.T])
    return fine if finer == 1 else np.ascontiguousarray(lowpass(fine, PASSBAND * 0.5 / finer)[::finer])


@dataclass(frozen=True)
class Resample(Step):
    """Bring uneven time, or another rate, to a fixed period.

    All channels are treated alike, so linear relations between them survive. At the same or a higher rate this is linear interpolation.
    When the rate falls, the samples are interpolated to a grid that is an integer number of times finer, filtered without delay below the
    new Nyquist frequency, and thinned. A gap longer than `max_gap_s` (default: ten median steps) is an error rather than a straight line.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> from kros.data.steps import Resample
    >>> population = kros.from_arrays({"a": [np.arange(4.0)[:, None]]}, states=["x"], measured=["x"], sample_period_s=0.01)
    >>> finer = kros.data.prepare(population, [Resample(0.005)])
    >>> finer.read(finer.keys()[0]).ravel().tolist()
    [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
    """

    period_s: float
    max_gap_s: float | None = None
    step: ClassVar[str] = "resample"
    makes_even: ClassVar[bool] = True

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
        time: Float = (
            np.arange(len(recording.values), dtype=np.float64) * period_s
            if recording.time_s is None
            else recording.time_s
        )
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

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> from kros.data.steps import Differentiate
    >>> time_s = 0.01 * np.arange(200)
    >>> population = kros.from_arrays({"a": [time_s[:, None] ** 2]}, states=["angle"], measured=["angle"], sample_period_s=0.01)
    >>> with_rate = kros.data.prepare(population, [Differentiate("angle", "rate", cutoff_hz=5.0)])
    >>> with_rate.states, float(with_rate.read(with_rate.keys()[0])[100, 1].round(6))
    (('angle', 'rate'), 2.0)
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
            raise ConfigError(
                f"Step 'differentiate' would add {self.name!r}, which is there already; choose another name."
            )
        at = self._position(channels)
        return (*channels[:at], Channel(self.name, Role.STATE, self.unit), *channels[at:])

    def scaling_after(self, scaling: Scalings) -> Scalings:
        """Return where channels come from: the derivative has the factor of its channel, and no column."""
        return {**scaling, self.name: replace(scaling_of(scaling, self.channel), column=None, offset="")}

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
        return replace(
            recording,
            values=np.insert(recording.values, self._position(channels), np.gradient(smooth, period_s), axis=1),
        )

    @staticmethod
    def _position(channels: tuple[Channel, ...]) -> int:
        return sum(c.role is Role.STATE for c in channels)
