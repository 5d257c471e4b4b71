r"""What is declared of a machine: its sensors and the limits of its states.

What arrives at sample k of a measured channel y is

.. math:: y_k = Q\bigl(y(t_k - (d + j\,\xi_k)\,\Delta t) + b + \sigma\,\eta_k\bigr),

or nothing with probability p: ``noise`` :math:`\sigma`, ``bias`` b, ``delay_samples`` d, ``jitter_samples`` j,
``dropout`` p, Q rounding to multiples of ``resolution``, :math:`\xi` and :math:`\eta` white and Gaussian of variance
one. It is beside what the recordings already hold. Limits of states, such as the current's, are declared or found in
the recordings.
"""

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


class Sensor(Settings):
    """The sensor of one measured channel; noise, resolution and bias in the channel's unit of measure.

    Examples
    --------
    >>> from kros.observer import Sensor
    >>> sensor = Sensor(noise=1e-3, resolution=1e-2, delay_samples=1)
    >>> round(sensor.variance() ** 0.5, 6), sensor.dropout
    (0.003055, 0.0)
    """

    noise: float = Field(0.0, ge=0, description="standard deviation of white noise")
    resolution: float | None = Field(
        None, ge=0, description="step; that found in the recordings where none is declared"
    )
    bias: float = Field(
        0.0,
        description="size of a constant offset; nothing can correct it, but the estimator avoids what would feel it",
    )
    delay_samples: int = Field(0, ge=0, description="samples by which measurements arrive late")
    jitter_samples: float = Field(0.0, ge=0, description="standard deviation of the moment of measurement, in samples")
    dropout: float = Field(0.0, ge=0, lt=1, description="probability that a sample is lost, independently of others")

    def variance(self, step: float = 0.0) -> float:
        """Return the variance of noise, rounding, and jitter of a signal of RMS `step` from sample to sample."""
        return self.noise**2 + (self.resolution or 0.0) ** 2 / 12 + (self.jitter_samples * step) ** 2

    def in_unit(self, size: float) -> Sensor:
        """Return the same for a channel that is divided by a size."""
        resolution = None if self.resolution is None else self.resolution / size
        return self.model_copy(update={"noise": self.noise / size, "bias": self.bias / size, "resolution": resolution})


Sensors = Mapping[str, Sensor]


def require_measured(sensor: Sensors, measured: Sequence[str]) -> None:
    """Refuse the sensor of what is not measured, and channels that are late by different numbers of samples."""
    if unknown := sorted(set(sensor) - set(measured)):
        raise ConfigError(
            f"sensor: {', '.join(unknown)} should be among the states that are measured, {', '.join(measured)}."
        )
    delays = {name: sensor.get(name, Sensor()).delay_samples for name in measured}
    if len(set(delays.values())) > 1:
        raise ConfigError(
            f"sensor: delay_samples should be the same for all measured states, found {delays}; hold back those that "
            "arrive early, and declare that."
        )


def delay_of(sensor: Sensors) -> int:
    """Return the samples by which measurements arrive late."""
    return max((own.delay_samples for own in sensor.values()), default=0)


def in_units(sensor: Sensors, sizes: Mapping[str, float]) -> dict[str, Sensor]:
    """Return sensors of channels that are divided by sizes, by name; one that is not named stays as it is."""
    return {name: own.in_unit(sizes.get(name, 1.0)) for name, own in sensor.items()}


class Limit(Settings):
    """Limits of one state: ``0.35`` for both sides, ``[-0.2, 0.35]``, ``{upper = 0.35}``, or false for none."""

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
