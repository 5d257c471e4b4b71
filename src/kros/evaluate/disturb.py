"""Disturbed measurements: a sensor, line or calibration worse than in the recordings.

The batch of episodes is repeated for every disturbance, disturbance outermost, so that observers run on all of them in
one pass. Disturbances of one kind share their random draws (the samples that are lost at 5 % are lost at 10 %, too), so
that errors over severity are smooth. Estimates are compared with the recordings as they are.

    episodes --disturb--> measurements --observers--> estimates --recordings--> errors over severity
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from ..data.batch import EpisodeBatch
from ..data.population import EpisodeKey
from .errors import error_percent

Array = npt.NDArray[np.float64]
Row = dict[str, Any]


class Kind(str, Enum):
    """What is wrong with the measurements."""

    DROPPED = "dropped"  # single samples at random: share of samples
    GAP = "gap"  # a tenth of all samples, in pieces of so many samples
    BIAS = "bias"  # share of the largest value
    QUANTISATION = "quantisation"  # rounded to multiples of a step: share of the largest value
    NOISE = "noise"  # white: standard deviation as a share of the largest value
    PHASE = "phase"  # error of the lifting parameter, in its own unit
    DELAY = "delay"  # samples, unknown to the observer


@dataclass(frozen=True)
class Disturbance:
    """A kind of disturbance with its severity, in the kind's unit; zero disturbs nothing."""

    kind: Kind
    severity: float


def standard_disturbances(kinds: Sequence[Kind] = tuple(Kind)) -> list[Disturbance]:
    """Return the disturbances of a study: six severities of every kind, evenly spaced on a logarithmic axis."""
    steps = np.arange(6)
    severities = {
        Kind.DROPPED: 0.5 ** (steps[::-1] + 1.0),
        Kind.GAP: np.round(10 ** (1 + 0.4 * steps)),
        Kind.PHASE: np.pi * 0.5 ** steps[::-1],
        Kind.DELAY: 2.0**steps,
    }
    shares = 10.0 ** (steps - 7)  # of the largest value
    return [Disturbance(kind, float(severity)) for kind in kinds for severity in severities.get(kind, shares)]


@dataclass(frozen=True, eq=False)
class Measured:
    """Measurements of a batch of episodes, and what is calibrated about the machines behind them."""

    y: Array  # shape (n_samples, batch, q)
    parameters: Mapping[str, Array]  # lifting parameters, shape (batch,)
    size: Array  # largest value of every measurement, shape (q,)

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
                rng = np.random.default_rng([seed, list(Kind).index(disturbance.kind), 0])
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
    period = min(10 * length, n_samples)  # so gaps take a tenth of all samples, whatever their length
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


Run = Callable[[Sequence[EpisodeKey], Array, Array, Mapping[str, Array]], Iterable[Array]]


def disturbed_errors(
    batch: EpisodeBatch, measured: Sequence[int], disturbances: Sequence[Disturbance], run: Run
) -> list[Array]:
    """Return errors in percent of all estimators, (1 + disturbance, batch, n), the first undisturbed."""
    every, n = (None, *disturbances), batch.states.shape[-1]
    size = np.abs(batch.states[..., list(measured)]).max(axis=(0, 1))
    given = Measured(batch.measurements(measured), batch.parameters, size).under(every)
    inputs, errors = np.tile(batch.inputs, (1, len(every), 1)), list[Array]()
    for estimates in run(batch.keys * len(every), given.y, inputs, given.parameters):
        for estimate in estimates:
            parts = np.split(estimate[..., :n], len(every), axis=1)
            errors.append(np.stack([error_percent(part, batch.states, batch.lengths) for part in parts]))
    return errors


def disturbed_rows(errors: Array, disturbances: Sequence[Disturbance], channels: Mapping[int, str]) -> Iterator[Row]:
    """Yield a row a disturbance, severity and channel: mean and worst over episodes, None where one diverged."""
    severities = [("none", 0.0), *((d.kind.value, float(d.severity)) for d in disturbances)]
    for (kind, severity), of_episodes in zip(severities, errors, strict=True):
        for column, channel in channels.items():
            values = of_episodes[:, column]
            known = bool(np.isfinite(values).all())
            error = {name: float(of(values)) if known else None for name, of in (("mean", np.mean), ("worst", np.max))}
            yield {"disturbance": kind, "severity": severity, "channel": channel, "error_percent": error}


def severity_of_growth(severities: npt.ArrayLike, errors: npt.ArrayLike, factor: float = 2.0) -> float:
    """Return the severity at which an error reaches a multiple of that without disturbance."""
    s, e = np.asarray(severities, dtype=float), np.asarray(errors, dtype=float)
    if s.shape != e.shape or s.ndim != 1 or not len(s) or s[0] != 0:
        raise DimensionError(f"Severity of growth: {s} should begin at zero, with as many errors, found {e.shape}.")
    limit = factor * e[0]
    beyond = np.flatnonzero(~(e < limit))
    if not len(beyond) or beyond[0] == 0:
        return np.inf if not len(beyond) else 0.0
    k = beyond[0]
    share = (limit**2 - e[k - 1] ** 2) / (e[k] ** 2 - e[k - 1] ** 2) if np.isfinite(e[k]) else 1.0
    return float(np.sqrt(s[k - 1] ** 2 + share * (s[k] ** 2 - s[k - 1] ** 2)))
