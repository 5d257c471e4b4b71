"""Baselines without a certificate, since they are no constant correction of a model; they run in the evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, SynthesisError
from ..data import EpisodeBatch
from ..data.population import EpisodeKey
from ..evaluate import error_percent
from ..evaluate.disturb import hold_missing
from ..identify import ModelSet
from ..observer import Seen
from ..observer.baselines.difference import FilteredDifference, cutoffs_hz, followed
from ..observer.baselines.extended_kalman import ExtendedKalman, start_covariance
from ..observer.baselines.kalman import like_measurement_noise
from ..observer.baselines.learned import Moments, Ridge
from ..observer.residual.one_step import one_step_covariance, one_step_residual
from ..observer.screen import Screen, Screened
from ..observer.sensor import delay_of
from .validation import TrainingSet, rank

Array = npt.NDArray[np.float64]
Parameters = Mapping[str, Array]


@dataclass(frozen=True)
class BaselineSettings:
    """How baselines are tuned and trained."""

    levels: tuple[float, ...] = (-4.0, -2.0, 0.0, 2.0, 4.0)  # decades of the extended filter's process noise
    extended_samples: int = 2_000  # of an episode, on which these are compared
    profile_samples: int = 5_000_000  # of the mean profile, at most, once every unit and condition has been read
    same_motion: float = 0.01  # RMS difference of inputs of the same motion, share of the largest input


DEFAULT = BaselineSettings()


class Estimator(Protocol):
    """What can be run over a batch of episodes."""

    def run(self, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
        """Return estimates, shape (n_samples, batch, n)."""


@dataclass(frozen=True, eq=False)
class Baseline:
    """A baseline that was tuned or trained."""

    by_unit: Mapping[str, Estimator]
    measured: tuple[int, ...]
    estimated: tuple[int, ...]
    facts: dict[str, Any]
    restarts: bool = True
    limits: tuple[Array, Array] | None = None
    seen: Seen | None = None

    def run(self, batch: EpisodeBatch, parameters: Parameters) -> Array:
        """Estimate all episodes, each with the estimator of its unit; NaN for states that are not estimated."""
        return self.estimate(batch.keys, batch.measurements(self.measured), batch.inputs, parameters)

    def estimate(self, keys: Sequence[EpisodeKey], y: Array, u: Array, parameters: Parameters) -> Array:
        """Estimate episodes from measurements and inputs, shape (n_samples, batch, q) and (..., m), NaN where lost."""
        units: dict[str, list[int]] = {}
        for i, key in enumerate(keys):
            units.setdefault(key.unit if key.unit in self.by_unit else "", []).append(i)
        samples, estimate = Screen.sized(self.seen, y.shape[-1], u.shape[-1]).take(y, u), np.empty(0)
        for unit, rows in units.items():
            values = {k: v[rows] for k, v in parameters.items()}
            estimator, some = self.by_unit[unit], samples.of(rows)
            if isinstance(estimator, ExtendedKalman):
                part = estimator.run(some.y, some.u, values, some.starts)
            elif self.restarts:
                part = restarted(estimator, some, values)
            else:
                part = estimator.run(some.y, some.u, values)
            estimate = estimate if estimate.size else np.empty((*y.shape[:2], part.shape[-1]))
            estimate[:, rows] = part
        return estimate if self.limits is None else np.clip(estimate, *self.limits)


def restarted(estimator: Estimator, samples: Screened, parameters: Mapping[str, npt.ArrayLike]) -> Array:
    """Run a batch, missing measurements held, every member again from each sample at which it starts again."""
    n_samples, batch = samples.starts.shape
    estimate = estimator.run(hold_missing(samples.y), samples.u, parameters)
    for begin in np.flatnonzero(samples.starts[1:].any(axis=1)) + 1:
        members = np.flatnonzero(samples.starts[begin])
        again = samples.starts[begin + 1 :, members]
        lasts = np.where(again.any(axis=0), begin + 1 + again.argmax(axis=0), n_samples - 1) if len(again) else begin
        rows = slice(begin, int(np.max(lasts)) + 1)
        part = {name: np.broadcast_to(np.asarray(v, dtype=float), (batch,))[members] for name, v in parameters.items()}
        y, u = hold_missing(samples.y[rows, members]), samples.u[rows, members]
        estimate[begin + 1 : rows.stop, members] = estimator.run(y, u, part)[1:]
    return estimate


def make_extended(
    training: TrainingSet, models: ModelSet, unit: str, noise: Array, settings: BaselineSettings = DEFAULT
) -> Baseline:
    """Tune the extended Kalman filter of a nominal model: process noise of many sizes, all run side by side."""
    batch, lifting, n = training.read(), models.lifting, models.lifting.n_states
    row, C, R = models.index(unit), list(models.measured), np.diag(noise**2)
    residual = one_step_residual(lifting, models.A[row], models.B[row], batch.states, batch.inputs, batch.parameters)
    shape = one_step_covariance(residual, batch.lengths - 1 - lifting.history)
    shape = shape * like_measurement_noise(shape[np.ix_(C, C)], R)
    filters = ExtendedKalman(
        lifting,
        models.A[row],
        models.B[row],
        models.measured,
        models.recorded_inputs,
        np.stack([10**level * shape for level in settings.levels]),
        R,
        start_covariance(models.output_scale[:n], R, models.measured),
        {name: float(v[row]) for name, v in models.parameters.items()},
        delay_of(training.sensor),
    )
    short = batch.head(settings.extended_samples)
    estimates = filters.run_all(short.measurements(models.measured), short.inputs, short.parameters)
    percents = [error_percent(estimate, short.states, short.lengths).mean(axis=0) for estimate in estimates]
    bounded = [np.where(np.isfinite(p), p, np.inf) for p in percents]
    first = min(range(len(bounded)), key=lambda i: rank(bounded[i], np.full(n, 100.0), models.measured))
    if not np.isfinite(bounded[first]).all():
        raise SynthesisError("Extended Kalman filter: every candidate diverges on the training episodes.")
    facts = {"status": "tuned", "process_noise_level": 10 ** settings.levels[first]}
    tuned = {"": replace(filters, Q=filters.Q[first])}
    return Baseline(tuned, models.measured, tuple(range(n)), facts, seen=training.seen)


def make_difference(training: TrainingSet, measured: tuple[int, ...]) -> Baseline:
    """Choose the cut-off of the filtered difference and find its scale."""
    population, batch = training.population, training.read()
    y, period = batch.measurements(measured), population.sample_period_s
    pairs = followed(batch, measured)
    if not pairs:
        states = ", ".join(population.states)
        raise ConfigError(
            f"Filtered difference: no state of {states} follows the rate of a measured one; record the rate."
        )
    estimated = tuple(state for _, state in pairs)
    truth, tried = batch.states[..., estimated], list[tuple[float, FilteredDifference]]()
    for cutoff in cutoffs_hz(period):
        trial = FilteredDifference(len(population.states), pairs, float(cutoff), period).scaled_to(batch, measured)
        error = error_percent(trial.run(y, batch.inputs)[..., estimated], truth, batch.lengths)
        tried.append((float(error.mean()), trial))
    best = min(tried, key=lambda pair: pair[0])[1]
    facts = {"status": "tuned", "cutoff_hz": best.cutoff_hz}
    return Baseline({"": best}, measured, estimated, facts, seen=training.seen)


def make_learned(training: TrainingSet, measured: tuple[int, ...]) -> Baseline:
    """Train the learned estimator on whole training episodes of all units, once for every unit without it."""
    samples = len(training.population.read(training.keys[0])) * len(training.keys)
    step = max(1, samples // Ridge().rows)
    moments = Moments.of(training.one_by_one(), measured, step)
    facts = {"status": "trained", "episodes": len(training.keys), "left_out": "the unit under test"}
    estimators = {unit: moments.estimator([unit]) for unit in moments.units} | {"": moments.estimator()}
    return Baseline(estimators, measured, moments.estimated, facts, seen=training.seen)
