"""What every preparation step is: facts about what it leaves, and its application to one recording."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

from ...core.errors import ConfigError
from ...core.files import did_you_mean
from ..population import Channel
from ..recording import Recording
from ..scaling import Scalings


@dataclass(frozen=True)
class Step:
    """Base of all steps; `step` is the word that selects one in TOML, `makes_even` says that recordings of uneven time may enter.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import numpy as np
    >>> import kros
    >>> class Magnitude(kros.data.steps.Step):
    ...     def apply(self, recording, channels, period_s):
    ...         return replace(recording, values=abs(recording.values))
    >>> population = kros.from_arrays({"a": [-np.ones((3, 1))]}, states=["x"], measured=["x"], sample_period_s=0.01)
    >>> positive = kros.data.prepare(population, [Magnitude()])
    >>> positive.read(positive.keys()[0]).ravel().tolist()
    [1.0, 1.0, 1.0]
    """

    step: ClassVar[str] = ""
    makes_even: ClassVar[bool] = False

    def channels_after(self, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels as this step leaves them."""
        return channels

    def period_after(self, period_s: float) -> float:
        """Return the sampling period as this step leaves it, s."""
        return period_s

    def apply(self, recording: Recording, channels: tuple[Channel, ...], period_s: float) -> Recording:
        """Return the prepared recording; `channels` and `period_s` describe the one given."""
        raise NotImplementedError

    def scaling_after(self, scaling: Scalings) -> Scalings:
        """Return where channels come from, with what this step does to them."""
        return scaling

    def without(self, names: Collection[str]) -> Step | None:
        """Return the step where some channels are absent: for those that are left, or None where it has nothing to do."""
        wanted = getattr(self, "channels", None)
        if wanted is not None:
            left = tuple(name for name in wanted if name not in names)
            return replace(self, channels=left) if left else None  # type: ignore[call-arg]
        return None if {getattr(self, "channel", None), getattr(self, "reference", None)} & set(names) else self

    def columns(self, names: Sequence[str], channels: tuple[Channel, ...]) -> list[int]:
        """Return the columns of named channels, or say which name is unknown."""
        known = [c.name for c in channels]
        for name in names:
            if name not in known:
                raise ConfigError(
                    f"Step {self.step!r} asks for channel {name!r}{did_you_mean(name, known) or ';'} there are {known}; correct the name."
                )
        return [known.index(name) for name in names]
