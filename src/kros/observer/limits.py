"""Limits of a machine's states, such as the current's: declared, or found in the recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from ..core.errors import ConfigError
from ..core.settings import Settings
from ..data.flat_tops import FoundLimit

Array = npt.NDArray[np.float64]


class Limit(Settings):
    """Limits of one state in its unit of measure; written as ``0.35`` for both sides, ``[-0.2, 0.35]``, ``{upper = 0.35}``, or false for none."""

    lower: float | None = Field(None, description="least value in the state's unit of measure")
    upper: float | None = Field(None, description="largest value")

    @model_validator(mode="before")
    @classmethod
    def _written(cls, raw: Any) -> Any:
        if raw is False:
            return {}
        if isinstance(raw, int | float) and not isinstance(raw, bool):
            return {"lower": -raw, "upper": raw}
        if isinstance(raw, list | tuple) and len(raw) == 2:
            return {"lower": raw[0], "upper": raw[1]}
        return raw

    @model_validator(mode="after")
    def _apart(self) -> Limit:
        if self.lower is not None and self.upper is not None and not self.lower < self.upper:
            raise ValueError(f"the lower limit {self.lower:g} should be below the upper one, {self.upper:g}")
        return self

    def in_unit(self, size: float) -> Limit:
        """Return the same for a channel that is divided by a size."""
        return Limit(
            lower=None if self.lower is None else self.lower / size,
            upper=None if self.upper is None else self.upper / size,
        )


Limits = Mapping[str, Limit]


def limits_of(declared: Limits, found: Mapping[str, FoundLimit], states: Sequence[str]) -> dict[str, Limit]:
    """Return limits by state: what is declared, else what was found."""
    if unknown := sorted(set(declared) - set(states)):
        raise ConfigError(f"limits: {', '.join(unknown)} should be among the recorded states, {', '.join(states)}.")
    of = {name: Limit(lower=own.lower, upper=own.upper) for name, own in found.items()} | dict(declared)
    return {name: of[name] for name in states if name in of and of[name] != Limit()}


def sides(limits: Limits, states: Sequence[str]) -> tuple[Array, Array]:
    """Return lower and upper limits of some states, infinite where there is none."""
    own = [limits.get(name, Limit()) for name in states]
    lower = [-np.inf if one.lower is None else one.lower for one in own]
    return np.array(lower), np.array([np.inf if one.upper is None else one.upper for one in own])
