"""Preparation steps that follow what the signals do: cuts where a threshold is crossed, signs and channels that change with the direction."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, DataError
from ..population import Channel
from ..recording import Recording, title
from .step import Step

Crossing = Literal["rising", "falling"]


@dataclass(frozen=True)
class Cut(Step):
    """Keep what is between two events: crossings of `threshold` by `channel`.

    From the first crossing in the direction `start`, and `before` samples before it, to the first one behind it in the direction `stop`, and `after`
    samples behind that; without one of them, from the first sample or to the last.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> from kros.data.steps import Cut
    >>> population = kros.from_arrays({"a": [np.arange(10.0)[:, None]]}, states=["x"], measured=["x"], sample_period_s=0.01)
    >>> between = kros.data.prepare(population, [Cut("x", 3.5, start="rising")])
    >>> between.read(between.keys()[0]).ravel().tolist()
    [4.0, 5.0, 6.0, 7.0, 8.0, 9.0]
    """

    channel: str
    threshold: float
    start: Crossing | None = None
    stop: Crossing | None = None
    before: int = 0
    after: int = 0
    step: ClassVar[str] = "cut"

    def channels_after(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels, unchanged."""
        self.columns((self.channel,), channels)
        if (self.start is None and self.stop is None) or min(self.before, self.after) < 0 or not math.isfinite(self.threshold):
            raise ConfigError(
                f"Step 'cut' needs start or stop, rising or falling, a finite threshold, and before and after of at least 0, found {self}; correct it."
            )
        return channels

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the recording between its events."""
        (column,) = self.columns((self.channel,), channels)
        signal, n = recording.values[:, column], len(recording.values)
        first = 0 if self.start is None else self._crossing(recording, signal, self.start, 1)
        last = n if self.stop is None else self._crossing(recording, signal, self.stop, first + 1) + self.after
        keep = slice(max(first - self.before, 0), min(last, n))
        return replace(recording, values=recording.values[keep], time_s=None if recording.time_s is None else recording.time_s[keep])

    def _crossing(self, recording: Recording, signal: npt.NDArray[np.float64], direction: Crossing, since: int) -> int:
        """Return the first sample from `since` on that is on the other side of the threshold than the one before it."""
        beyond = signal >= self.threshold
        crossed = beyond[1:] & ~beyond[:-1] if direction == "rising" else ~beyond[1:] & beyond[:-1]
        found = np.flatnonzero(crossed) + 1
        found = found[found >= since]
        if not found.size:
            raise DataError(
                f"{title(recording.key)}: {self.channel!r} never crosses {self.threshold:g} {direction} behind sample {since - 1}, found values from "
                f"{np.min(signal):g} to {np.max(signal):g}; correct the step 'cut', or leave the episode out."
            )
        return int(found[0])


@dataclass(frozen=True)
class ByDirection(Step):
    """Where a machine runs backwards, negate some channels and exchange others.

    For sensors that know no sign, and for two sides that change their parts. Backwards is where `channel` is below zero, sample by sample, or in
    the mean of the whole episode (``each = "episode"``).

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> from kros.data.steps import ByDirection
    >>> arrays = {"a": [np.array([[1.0, 3.0], [-1.0, 3.0], [-2.0, 4.0]])]}
    >>> population = kros.from_arrays(arrays, states=["v", "force"], measured=["v"], sample_period_s=0.01)
    >>> signed = kros.data.prepare(population, [ByDirection("v", negate=("force",))])
    >>> signed.read(signed.keys()[0])[:, 1].tolist()
    [3.0, -3.0, -4.0]
    """

    channel: str
    negate: tuple[str, ...] = ()
    swap: tuple[tuple[str, ...], ...] = ()
    each: Literal["sample", "episode"] = "sample"
    step: ClassVar[str] = "by_direction"

    def without(self, names: Collection[str]) -> Step | None:
        """Return the step for the channels that are left."""
        negate, swap = tuple(n for n in self.negate if n not in names), tuple(p for p in self.swap if not set(p) & set(names))
        return replace(self, negate=negate, swap=swap) if self.channel not in names and (negate or swap) else None

    def channels_after(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels, unchanged."""
        self.columns((self.channel, *self.negate), channels)
        for pair in self.swap:
            sides = [channels[i] for i in self.columns(pair, channels)]
            if len(sides) != 2 or sides[0].unit != sides[1].unit or sides[0].role is not sides[1].role:
                raise ConfigError(
                    f"Step 'by_direction': swap needs pairs of channels with one role and unit, found {list(pair)}; correct it."
                )
        if not self.negate and not self.swap:
            raise ConfigError("Step 'by_direction' needs channels to negate or to swap; name some, or remove the step.")
        return channels

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the recording as if it ran forwards."""
        (column,) = self.columns((self.channel,), channels)
        direction = recording.values[:, column]
        back = direction < 0 if self.each == "sample" else np.full(len(direction), np.mean(direction) < 0)
        values = recording.values.copy()
        for i in self.columns(self.negate, channels):
            values[back, i] *= -1
        for pair in self.swap:
            one, other = self.columns(pair, channels)
            values[back, one], values[back, other] = values[back, other], values[back, one]
        return replace(recording, values=values)
