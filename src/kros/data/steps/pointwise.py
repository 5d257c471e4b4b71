"""Preparation steps that scale, shift, remove an offset and cut."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ...core.errors import ConfigError, DataError
from ..checks import check_finite
from ..population import Channel
from ..recording import Recording, title
from ..scaling import Scalings, scaling_of
from .step import Step


@dataclass(frozen=True)
class Scale(Step):
    """Multiply channels by a factor; `unit` names the new unit of measure.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> from kros.data.steps import Scale
    >>> population = kros.from_arrays({"a": [np.full((3, 1), 180.0)]}, states=["angle"], measured=["angle"], sample_period_s=0.01)
    >>> turned = kros.data.prepare(population, [Scale(("angle",), np.pi / 180, unit="rad")])
    >>> turned.channels[0].unit, turned.read(turned.keys()[0]).ravel().round(3).tolist()
    ('rad', [3.142, 3.142, 3.142])
    """

    channels: tuple[str, ...]
    factor: float
    unit: str | None = None
    step: ClassVar[str] = "scale"

    def channels_after(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels with their new unit of measure."""
        if not math.isfinite(self.factor) or self.factor == 0:
            raise ConfigError(f"Step 'scale' needs a finite factor other than zero, found {self.factor}; correct it.")
        self.columns(self.channels, channels)
        return (
            channels
            if self.unit is None
            else tuple(replace(c, unit=self.unit) if c.name in self.channels else c for c in channels)
        )

    def scaling_after(self, scaling: Scalings) -> Scalings:
        """Return where channels come from, multiplied."""
        before = {name: scaling_of(scaling, name) for name in self.channels}
        return {**scaling, **{name: replace(own, factor=own.factor * self.factor) for name, own in before.items()}}

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the recording with some columns multiplied."""
        values = recording.values.copy()
        for column in self.columns(self.channels, channels):
            with np.errstate(over="ignore"):  # infinity is refused by the checks, with its place
                values[:, column] *= self.factor
        return replace(recording, values=values)


@dataclass(frozen=True)
class Shift(Step):
    """Move channels that lag the others by `lag` samples back into place.

    The value recorded at sample ``k + lag`` is moved to sample ``k``; the ends that have no partner are cut. A negative `lag`
    moves channels that run ahead.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> from kros.data.steps import Shift
    >>> arrays = {"a": [np.array([[0.0, 9.0], [1.0, 0.0], [2.0, 1.0], [3.0, 2.0]])]}
    >>> population = kros.from_arrays(arrays, states=["x", "late"], measured=["x"], sample_period_s=0.01)
    >>> aligned = kros.data.prepare(population, [Shift(("late",), lag=1)])
    >>> aligned.read(aligned.keys()[0]).tolist()
    [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]
    """

    channels: tuple[str, ...]
    lag: int
    step: ClassVar[str] = "shift"

    def channels_after(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels, unchanged."""
        self.columns(self.channels, channels)
        return channels

    def scaling_after(self, scaling: Scalings) -> Scalings:
        """Return where channels come from, moved."""
        before = {name: scaling_of(scaling, name) for name in self.channels}
        return {
            **scaling,
            **{name: replace(own, lag_samples=own.lag_samples + self.lag) for name, own in before.items()},
        }

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the aligned recording, `abs(lag)` samples shorter."""
        n, lag = len(recording.values), self.lag
        if n <= abs(lag):
            raise DataError(
                f"{title(recording.key)}: shifting by {lag} samples leaves nothing of {n}; leave the episode out."
            )
        length = n - abs(lag)
        fixed, moved = max(0, -lag), max(0, lag)
        values = recording.values[fixed : fixed + length].copy()
        for column in self.columns(self.channels, channels):
            values[:, column] = recording.values[moved : moved + length, column]
        return replace(
            recording,
            values=values,
            time_s=None if recording.time_s is None else recording.time_s[fixed : fixed + length],
        )


@dataclass(frozen=True)
class Offset(Step):
    """Remove a channel's constant offset: ``channel += mean(reference - channel)`` over samples ``[start, stop)`` of each episode.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> from kros.data.steps import Offset
    >>> target = np.arange(4.0)
    >>> arrays = {"a": [np.column_stack([target + 0.5, target])]}
    >>> population = kros.from_arrays(arrays, states=["x"], measured=["x"], inputs=["target"], sample_period_s=0.01)
    >>> shifted = kros.data.prepare(population, [Offset("x", "target", 0, 2)])
    >>> shifted.read(shifted.keys()[0])[:, 0].tolist()
    [0.0, 1.0, 2.0, 3.0]
    """

    channel: str
    reference: str
    start: int
    stop: int
    step: ClassVar[str] = "offset"

    def channels_after(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels, unchanged."""
        self.columns((self.channel, self.reference), channels)
        if not 0 <= self.start < self.stop:
            raise ConfigError(
                f"Step 'offset' needs 0 <= start < stop, found start = {self.start}, stop = {self.stop}; correct the window."
            )
        return channels

    def scaling_after(self, scaling: Scalings) -> Scalings:
        """Return where channels come from, with the offset in words."""
        said = (
            f"mean of {self.reference} - {self.channel} over samples {self.start} to {self.stop - 1} of every episode"
        )
        return {**scaling, self.channel: replace(scaling_of(scaling, self.channel), offset=said)}

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the recording with the offset removed."""
        column, reference = self.columns((self.channel, self.reference), channels)
        if len(recording.values) < self.stop:
            raise DataError(
                f"{title(recording.key)}: the offset of {self.channel!r} is calibrated over samples "
                f"{self.start}-{self.stop - 1}, the episode has "
                f"{len(recording.values)}; leave the episode out."
            )
        window = recording.values[self.start : self.stop]
        check_finite(window, recording.key, channels, first=self.start, columns=(column, reference))
        values = recording.values.copy()
        values[:, column] += np.mean(window[:, reference] - window[:, column])
        return replace(recording, values=values)


@dataclass(frozen=True)
class Trim(Step):
    """Keep samples ``[start, stop)``, without the last `tail`.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> from kros.data.steps import Trim
    >>> population = kros.from_arrays({"a": [np.arange(6.0)[:, None]]}, states=["x"], measured=["x"], sample_period_s=0.01)
    >>> trimmed = kros.data.prepare(population, [Trim(start=2, tail=1)])
    >>> trimmed.read(trimmed.keys()[0]).ravel().tolist()
    [2.0, 3.0, 4.0]
    """

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
                f"{title(recording.key)}: trimming to start = {self.start}, stop = {self.stop}, tail = {self.tail} "
                f"leaves nothing of {n} samples; "
                "leave the episode out or trim less."
            )
        keep = slice(self.start, stop)
        return replace(
            recording,
            values=recording.values[keep],
            time_s=None if recording.time_s is None else recording.time_s[keep],
        )
