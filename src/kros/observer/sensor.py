r"""What is declared of a machine's sensors.

What arrives at sample k of a measured channel y is

.. math:: y_k = Q\bigl(y(t_k - (d + j\,\xi_k)\,\Delta t) + b + \sigma\,\eta_k\bigr),

or nothing with probability p: ``noise`` :math:`\sigma`, ``bias`` b, ``delay_samples`` d, ``jitter_samples`` j,
``dropout`` p, Q rounding to multiples of ``resolution``, :math:`\xi` and :math:`\eta` white and Gaussian of variance
one. It is beside what the recordings already hold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pydantic import Field

from ..core import ConfigError, Settings


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
    delay_samples: int = Field(0, ge=0, le=500, description="samples by which measurements arrive late")
    jitter_samples: float = Field(0.0, ge=0, description="standard deviation of the moment of measurement, in samples")
    dropout: float = Field(0.0, ge=0, lt=1, description="probability that a sample is lost, independently of others")

    def variance(self, step: float = 0.0) -> float:
        """Return the variance of noise, rounding, and jitter of a signal of RMS `step` from sample to sample."""
        return self.noise**2 + (self.resolution or 0.0) ** 2 / 12 + (self.jitter_samples * step) ** 2

    def no_finer_than(self, resolution: float) -> Sensor:
        """Return the same with at least the resolution that recordings show."""
        return self.model_copy(update={"resolution": max(self.resolution or 0.0, resolution)})


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
            f"sensor: delay_samples should be the same for all measured states, found {delays}; hold early ones back."
        )


def delay_of(sensor: Sensors) -> int:
    """Return the samples by which measurements arrive late."""
    return max((own.delay_samples for own in sensor.values()), default=0)


def in_units(sensor: Sensors, sizes: Mapping[str, float]) -> dict[str, Sensor]:
    """Return sensors of channels that are divided by sizes, by name; one that is not named stays as it is."""
    found = {}
    for name, own in sensor.items():
        given = {key: getattr(own, key) for key in ("noise", "bias", "resolution")}
        changed = {key: value / sizes.get(name, 1.0) for key, value in given.items() if value is not None}
        found[name] = own.model_copy(update=changed)
    return found
