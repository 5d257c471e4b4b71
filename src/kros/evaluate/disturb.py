"""Disturbed measurements: a sensor, line or calibration worse than in the recordings.

The batch of episodes is repeated for every disturbance, disturbance outermost, so that observers run on all of them in
one pass. Disturbances of one kind share their random draws (the samples that are lost at 5 % are lost at 10 %, too), so
that errors over severity are smooth. Estimates are compared with the recordings as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DimensionError
from ..core.settings import member
from ..data.batch import hold_missing as hold_missing  # beside what makes them miss

Array = npt.NDArray[np.float64]
LOST_IN_GAPS = 0.1  # share of samples that gaps take, whatever their length


class Kind(str, Enum):
    """What is wrong with the measurements; the severity's unit behind it.

    DROPPED
        Single samples are missing at random: share of samples, 0 to 1.
    GAP
        Samples are missing in pieces of this many samples, at random places, a tenth of all samples and at least one
        piece an episode.
    BIAS
        A constant is added to every measurement: share of its largest value.
    QUANTISATION
        Measurements are rounded to multiples of a step: share of the largest value.
    NOISE
        White Gaussian noise is added: its standard deviation as a share of the largest value.
    PHASE
        The machine's lifting parameter is wrong, by so much in its own unit, rad for a phase.
    DELAY
        Measurements are delayed by this many samples, unknown to the observer.

    Examples
    --------
    >>> from kros.evaluate import Kind
    >>> [kind.value for kind in Kind]
    ['dropped', 'gap', 'bias', 'quantisation', 'noise', 'phase', 'delay']
    """

    DROPPED = "dropped"
    GAP = "gap"
    BIAS = "bias"
    QUANTISATION = "quantisation"
    NOISE = "noise"
    PHASE = "phase"
    DELAY = "delay"


@dataclass(frozen=True)
class Disturbance:
    """One disturbance.

    Parameters
    ----------
    kind : Kind or str
    severity : float
        In the unit of its kind; zero disturbs nothing.
    draw : int
        Number of the random draw; disturbances of one kind and draw share it.

    Raises
    ------
    ConfigError
        For a severity out of range.

    Examples
    --------
    >>> from kros.evaluate import Disturbance
    >>> Disturbance("dropped", 0.1).kind.value
    'dropped'
    """

    kind: Kind
    severity: float
    draw: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", member(Kind, self.kind, "Disturbance: the kind"))
        most = 1.0 if self.kind is Kind.DROPPED else np.inf
        if not 0 <= self.severity <= most or self.severity == np.inf:
            raise ConfigError(
                f"Disturbance {self.kind.value}: the severity {self.severity} should be between 0 and {most:g}."
            )
        if self.kind in {Kind.GAP, Kind.DELAY} and self.severity != int(self.severity):
            raise ConfigError(f"Disturbance {self.kind.value}: {self.severity} should be a whole number of samples.")


SEVERITIES: dict[Kind, tuple[float, ...]] = {
    Kind.DROPPED: (0.02, 0.05, 0.1, 0.2, 0.3, 0.5),
    Kind.GAP: (10, 30, 100, 300, 1000),
    Kind.BIAS: (1e-6, 1e-5, 1e-4, 1e-3, 1e-2),
    Kind.QUANTISATION: (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2),
    Kind.NOISE: (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2),
    Kind.PHASE: (np.pi / 16, np.pi / 8, np.pi / 4, np.pi / 2, np.pi),
    Kind.DELAY: (1, 2, 3, 4, 8, 16),
}


def standard_disturbances(kinds: Sequence[Kind] = tuple(Kind)) -> list[Disturbance]:
    """Return the disturbances of a study: five or six severities of every kind.

    Examples
    --------
    >>> from kros.evaluate import Kind, standard_disturbances
    >>> [disturbance.severity for disturbance in standard_disturbances([Kind.BIAS])]
    [1e-06, 1e-05, 0.0001, 0.001, 0.01]
    """
    return [Disturbance(kind, severity) for kind in kinds for severity in SEVERITIES[kind]]


@dataclass(frozen=True, eq=False)
class Measured:
    """Measurements of a batch of episodes, and what is calibrated about the machines behind them."""

    y: Array  # shape (n_samples, batch, q)
    parameters: Mapping[str, Array]  # mapping of str to ndarray, shape (batch,); Lifting parameters
    size: Array  # shape (q,); Range of every measurement

    def __post_init__(self) -> None:
        if self.y.ndim != 3 or self.size.shape != self.y.shape[2:]:
            raise DimensionError(
                f"Measurements {self.y.shape} should be (n_samples, batch, q), with a range for each, found "
                f"{self.size.shape}."
            )

    def under(self, disturbances: Sequence[Disturbance | None], seed: int = 0) -> Measured:
        """Return the measurements under every disturbance, side by side."""
        n_samples, batch, q = self.y.shape
        y = np.empty((n_samples, len(disturbances), batch, q))
        parameters = {
            name: np.repeat(values[None], len(disturbances), axis=0) for name, values in self.parameters.items()
        }
        for i, disturbance in enumerate(disturbances):
            y[:, i] = self.y
            if disturbance is None:
                continue
            if disturbance.kind is Kind.PHASE:
                for values in parameters.values():
                    values[i] += disturbance.severity
            else:
                rng = np.random.default_rng([seed, list(Kind).index(disturbance.kind), disturbance.draw])
                y[:, i] = _CHANGES[disturbance.kind](self, disturbance.severity, rng)
        flat = {name: values.reshape(-1) for name, values in parameters.items()}
        return Measured(y.reshape(n_samples, -1, q), flat, self.size)


def _dropped(measured: Measured, severity: float, rng: np.random.Generator) -> Array:
    lost = rng.random(measured.y.shape[:2]) < severity
    return _without(measured.y, lost)


def _gap(measured: Measured, severity: float, rng: np.random.Generator) -> Array:
    """One gap in every period, at a random place in it."""
    n_samples, batch, _ = measured.y.shape
    length = min(int(severity), n_samples - 1)
    if not length:
        return measured.y
    period = min(round(length / LOST_IN_GAPS), n_samples)
    k = np.arange(n_samples)[:, None]
    starts = 1 + np.floor(rng.random((-(-n_samples // period), batch)) * (period - length))
    inside = k % period - starts[k[:, 0] // period]
    return _without(measured.y, (inside >= 0) & (inside < length))


def _without(y: Array, lost: npt.NDArray[np.bool_]) -> Array:
    lost[0] = False
    return np.where(lost[..., None], np.nan, y)


def _bias(measured: Measured, severity: float, rng: np.random.Generator) -> Array:
    return measured.y + severity * measured.size


def _quantisation(measured: Measured, severity: float, rng: np.random.Generator) -> Array:
    step = severity * measured.size
    return np.asarray(np.where(step > 0, np.rint(measured.y / np.where(step > 0, step, 1.0)) * step, measured.y))


def _noise(measured: Measured, severity: float, rng: np.random.Generator) -> Array:
    return measured.y + severity * measured.size * rng.standard_normal(measured.y.shape)


def _delay(measured: Measured, severity: float, rng: np.random.Generator) -> Array:
    rows = np.maximum(np.arange(len(measured.y)) - int(severity), 0)
    return measured.y[rows]


_CHANGES: dict[Kind, Callable[[Measured, float, np.random.Generator], Array]] = {
    Kind.DROPPED: _dropped,
    Kind.GAP: _gap,
    Kind.BIAS: _bias,
    Kind.QUANTISATION: _quantisation,
    Kind.NOISE: _noise,
    Kind.DELAY: _delay,
}
