"""Preparation as declared steps: small frozen objects, applied to each episode in the order given.

A step describes what it does to the signals of all episodes (`describe`), so that a population can be described before
anything is read, and does it to one recording at a time (`apply`). No step changes its argument. In TOML a step is a
table with its name under `step`: ``[[data.prepare]] step = "trim" start = 1000``.

Examples
--------
The column `late` lags by a sample, and the angle, in degrees, has an offset that the target shows in the first samples:

>>> import kros
>>> from kros.data import steps
>>> names = {"states": ["angle", "late"], "inputs": ["target"], "measured": ["angle"], "sample_period_s": 0.01}
>>> rows = [[5.0, 9.0, 0.0], [5.0, 1.0, 0.0], [95.0, 2.0, 90.0], [185.0, 3.0, 180.0], [185.0, 4.0, 180.0]]
>>> data = kros.from_arrays({"a": [rows]}, **names)
>>> declared = [steps.Shift(("late",), lag=1), steps.Offset("angle", "target", 0, 2), steps.Trim(start=1)]
>>> prepared = kros.data.prepare(data, [*declared, steps.Scale(("angle",), 0.0174533, "rad")])
>>> prepared.read(prepared.keys()[0]).round(2).tolist(), prepared.channels[0].unit
([[0.0, 2.0, 0.0], [1.57, 3.0, 90.0], [3.14, 4.0, 180.0]], 'rad')
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pydantic import ConfigDict

from ..core import Array, ConfigError, DataError, Flags, Names, did_you_mean, frozen, limits
from .population import Channel, Channels, Role, Scalings, scaling_of
from .recording import CHECK, Recording, check_finite, check_increasing, estimate_period, title

__all__ = ["Differentiate", "Offset", "Resample", "Scale", "Shift", "Step", "Trim"]

GAP = 10.0  # median steps of time that a straight line bridges
PASSBAND = 0.8  # of a filter that makes the rate fall, as a share of the new Nyquist frequency


@frozen
class Signals:
    """The signals of all episodes before or after a step."""

    channels: Channels
    period_s: float
    scaling: Scalings = field(default_factory=dict)  # where channels come from

    def scaled(self, name: str, **changes: Any) -> Signals:
        """Return the signals with changes to where a channel comes from."""
        return replace(self, scaling={**self.scaling, name: replace(scaling_of(self.scaling, name), **changes)})


@dataclass(frozen=True)
class Step:
    """Base of all steps; `step` is its word in TOML, `makes_even` says that recordings of uneven time may enter.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import kros
    >>> class Magnitude(kros.data.steps.Step):
    ...     def apply(self, recording, channels, period_s):
    ...         return replace(recording, values=abs(recording.values))
    >>> data = kros.from_arrays({"a": [[[-1.0], [2.0]]]}, states=["x"], measured=["x"], sample_period_s=0.01)
    >>> kros.data.prepare(data, [Magnitude(), kros.data.steps.Trim(start=1)]).columns[0].name
    'x'
    """

    step, makes_even = "", False
    __pydantic_config__ = ConfigDict(extra="forbid")

    @property
    def named(self) -> Names:
        """Channels that this step needs."""
        names = getattr(self, "channels", None) or (getattr(self, "channel", None), getattr(self, "reference", None))
        return tuple(name for name in names if name is not None)

    def describe(self, signals: Signals) -> Signals:
        """Return the signals as this step leaves them; refuse settings that cannot be, and channels it does not fit."""
        self.columns(self.named, signals.channels)
        return signals

    def apply(self, recording: Recording, channels: Channels, period_s: float) -> Recording:
        """Return the prepared recording; `channels` and `period_s` describe the one given."""
        raise NotImplementedError

    def without(self, names: Collection[str]) -> Step | None:
        """Return the step for the channels that are left without some, or None where it has nothing to do."""
        left = tuple(name for name in self.named if name not in names)
        if hasattr(self, "channels") and left:
            return replace(self, channels=left)  # type: ignore[call-arg]
        return self if left == self.named and not hasattr(self, "channels") else None

    def columns(self, names: Sequence[str], channels: Channels) -> list[int]:
        """Return the columns of named channels, or say which name is unknown."""
        known = [c.name for c in channels]
        unknown = next((name for name in names if name not in known), None)
        if unknown is not None:
            hint = did_you_mean(unknown, known)
            raise ConfigError(f"Step {self.step!r} asks for channel {unknown!r}{hint} there are {known}; correct it.")
        return [known.index(name) for name in names]

    def _require(self, condition: bool, needs: str) -> None:
        if not condition:
            raise ConfigError(f"Step {self.step!r} needs {needs}; correct it.")


@dataclass(frozen=True)
class Scale(Step):
    """Multiply channels by a factor and add an offset; `unit` names the new unit of measure."""

    channels: Names
    factor: float
    unit: str | None = None
    offset: float = 0.0
    step = "scale"

    def describe(self, signals: Signals) -> Signals:
        """Return the signals with channels multiplied and their new unit of measure."""
        self._require(0 < abs(self.factor) < math.inf, f"a finite factor other than zero, found {self.factor}")
        signals = super().describe(signals)
        for name in self.channels:
            before = scaling_of(signals.scaling, name)
            added = ", ".join(filter(None, [before.offset, f"{self.offset:g}" if self.offset else ""]))
            signals = signals.scaled(name, factor=before.factor * self.factor, offset=added)
        units = {} if self.unit is None else dict.fromkeys(self.channels, self.unit)
        channels = (replace(c, unit=units.get(c.name, c.unit)) for c in signals.channels)
        return replace(signals, channels=tuple(channels))

    def apply(self, recording: Recording, channels: Channels, period_s: float) -> Recording:
        """Return the recording with some columns multiplied."""
        values = recording.values.copy()
        with np.errstate(over="ignore"):  # infinity is refused by the checks, with its place
            columns = self.columns(self.channels, channels)
            values[:, columns] = values[:, columns] * self.factor + self.offset
        return replace(recording, values=values)


@dataclass(frozen=True)
class Shift(Step):
    """Move channels that lag the others by `lag` samples back into place; a negative `lag` is a lead.

    The value recorded at sample ``k + lag`` is moved to sample ``k``; the ends that have no partner are cut.
    """

    channels: Names
    lag: int
    step = "shift"

    def describe(self, signals: Signals) -> Signals:
        """Return the signals with channels moved."""
        signals = super().describe(signals)
        for name in self.channels:
            lag = scaling_of(signals.scaling, name).lag_samples + self.lag
            signals = signals.scaled(name, lag_samples=lag)
        return signals

    def apply(self, recording: Recording, channels: Channels, period_s: float) -> Recording:
        """Return the aligned recording, `abs(lag)` samples shorter."""
        n, length = len(recording.values), len(recording.values) - abs(self.lag)
        if length <= 0:
            raise DataError(f"{title(recording.key)}: a shift by {self.lag} leaves nothing of {n} samples.")
        fixed, moved = max(0, -self.lag), max(0, self.lag)
        columns, rest = self.columns(self.channels, channels), recording.cut(fixed, fixed + length)
        values = rest.values.copy()
        values[:, columns] = recording.values[moved : moved + length, columns]
        return replace(rest, values=values)


@dataclass(frozen=True)
class Offset(Step):
    """Remove a channel's constant offset: ``channel += mean(reference - channel)`` over samples ``[start, stop)``."""

    channel: str
    reference: str
    start: int
    stop: int
    step = "offset"

    def describe(self, signals: Signals) -> Signals:
        """Return the signals with the offset in words."""
        self._require(0 <= self.start < self.stop, f"0 <= start < stop, found start = {self.start}, stop = {self.stop}")
        window = f"samples {self.start} to {self.stop - 1} of every episode"
        offset = f"mean of {self.reference} - {self.channel} over {window}"
        return super().describe(signals).scaled(self.channel, offset=offset)

    def apply(self, recording: Recording, channels: Channels, period_s: float) -> Recording:
        """Return the recording with the offset removed."""
        columns = self.columns((self.channel, self.reference), channels)
        if len(recording.values) < self.stop:
            raise DataError(
                f"{title(recording.key)}: the offset needs {self.stop} samples, found {len(recording.values)}."
            )
        window = recording.values[self.start : self.stop, columns]
        check_finite(window, recording.key, [channels[i] for i in columns], first=self.start)
        values = recording.values.copy()
        values[:, columns[0]] += np.mean(window[:, 1] - window[:, 0])
        return replace(recording, values=values)


@dataclass(frozen=True)
class Trim(Step):
    """Retain samples ``[start, stop)``, without the last `tail`."""

    start: int = 0
    stop: int | None = None
    tail: int = 0
    step = "trim"

    def describe(self, signals: Signals) -> Signals:
        """Refuse bounds in the wrong order."""
        ordered = self.stop is None or self.start < self.stop
        self._require(self.start >= 0 and self.tail >= 0 and ordered, f"0 <= start < stop and tail >= 0, found {self}")
        return signals

    def apply(self, recording: Recording, channels: Channels, period_s: float) -> Recording:
        """Return the shorter recording."""
        n = len(recording.values)
        stop = min(n if self.stop is None else self.stop, n - self.tail)
        if stop <= self.start:
            raise DataError(f"{title(recording.key)}: {self} leaves nothing of {n} samples; leave it out.")
        return recording.cut(self.start, stop)


@dataclass(frozen=True)
class Resample(Step):
    """Bring uneven time, or another rate, to a fixed period.

    At the same or a higher rate this is linear interpolation. When the rate falls, samples are interpolated to a grid
    that is an integer number of times finer, filtered without delay below 0.8 of the new Nyquist frequency, and
    thinned. All channels are treated alike, so linear relations between them survive. Samples in which a channel holds
    NaN or infinity count as not recorded.

    Parameters
    ----------
    period_s : float, s
    max_gap_s : float, optional, s
        Longest gap in time that a straight line bridges, default: ten median steps. A recording with longer ones is
        cut there, and its longest stretch stays.
    """

    period_s: float
    max_gap_s: float | None = None
    step = "resample"
    makes_even = True

    def describe(self, signals: Signals) -> Signals:
        """Return the signals at the new sampling period."""
        self._require(0 < self.period_s < math.inf, f"period_s > 0, found {self.period_s}")
        self._require(self.max_gap_s is None or self.max_gap_s > 0, f"max_gap_s > 0, found {self.max_gap_s}")
        return replace(signals, period_s=self.period_s)

    def apply(self, recording: Recording, channels: Channels, period_s: float) -> Recording:
        """Return the recording on the new grid, which starts at its first sample."""
        time = recording.times(period_s)
        timed = replace(recording, time_s=time)
        check_increasing(timed)
        start, stop = longest_stretch(np.diff(time) > (self.max_gap_s or GAP * estimate_period(timed)))
        timed, time = timed.cut(start, stop), time[start:stop]
        median = estimate_period(timed)
        count = (time[-1] - time[0]) / min(self.period_s, median)
        if count > limits.MAX_SAMPLES:
            raise DataError(f"{title(recording.key)}: resampling would make {count:g} samples; correct the period.")
        return replace(recording, values=self.on_grid(time, timed.values, median), time_s=None)

    def on_grid(self, time_s: Array, values: Array, median_s: float) -> Array:
        """Return samples at increasing times on an even grid from the first time on, shape (n_new, n_channels)."""
        finer = max(1, math.ceil(self.period_s / median_s - 1e-3))
        step = self.period_s / finer
        grid = time_s[0] + step * np.arange(math.floor((time_s[-1] - time_s[0]) / step + CHECK.end) + 1)
        fine = np.column_stack([np.interp(grid, time_s, column) for column in values.T])
        return fine if finer == 1 else np.ascontiguousarray(lowpass(fine, PASSBAND * 0.5 / finer)[::finer])


@dataclass(frozen=True)
class Differentiate(Step):
    """Add the derivative of a channel, low-passed at `cutoff_hz`, as a new state, or as the truth of a state `of`.

    The filter has no delay, so it looks ahead: the result is for identification and evaluation, never something a
    running observer could have measured.
    """

    channel: str
    name: str
    cutoff_hz: float
    unit: str = ""
    of: str = ""
    step = "differentiate"

    def describe(self, signals: Signals) -> Signals:
        """Return the signals with the new channel after those alike; it has the factor of its channel."""
        bound, channels = 0.5 / signals.period_s, super().describe(signals).channels
        needs = f"a cutoff_hz above zero and below the Nyquist frequency of {bound:g} Hz, found {self.cutoff_hz}"
        self._require(0 < self.cutoff_hz < bound, needs)
        added = replace(scaling_of(signals.scaling, self.channel), column=None, offset="")
        role, at = Role.TRUTH if self.of else Role.STATE, self._position(channels)
        channels = (*channels[:at], Channel(self.name, role, self.unit, of=self.of), *channels[at:])
        return replace(signals, channels=channels, scaling={**signals.scaling, self.name: added})

    def apply(self, recording: Recording, channels: Channels, period_s: float) -> Recording:
        """Return the recording with one more column."""
        smooth = lowpass(recording.values[:, self.columns(self.named, channels)], self.cutoff_hz * period_s)[:, 0]
        values = np.insert(recording.values, self._position(channels), np.gradient(smooth, period_s), axis=1)
        return replace(recording, values=values)

    def _position(self, channels: Channels) -> int:
        """Return where the new channel stands."""
        return len(channels) if self.of else [c.role for c in channels].count(Role.STATE)


def longest_stretch(breaks: Flags) -> tuple[int, int]:
    """Return the first sample of the longest stretch without a break to the next one, and its end."""
    edges = np.concatenate([[0], np.flatnonzero(breaks) + 1, [len(breaks) + 1]])
    longest = int(np.diff(edges).argmax())
    return int(edges[longest]), int(edges[longest + 1])


def lowpass(values: Array, cutoff: float) -> Array:
    """Filter columns without delay by a windowed sinc; ends are extended by odd reflection."""
    half = min(math.ceil(4 / cutoff), len(values) - 1) if cutoff > 0 else 0
    if cutoff >= 0.5 or half < 1:
        return values
    from scipy.signal import convolve, firwin

    taps = firwin(2 * half + 1, 2 * cutoff, window="hamming")[:, None]
    padded = np.pad(values, ((half, half), (0, 0)), "reflect", reflect_type="odd")
    return convolve(padded, taps, mode="valid")


STEPS: dict[str, type[Step]] = {kind.step: kind for kind in (Scale, Shift, Offset, Trim, Resample, Differentiate)}
