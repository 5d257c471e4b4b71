"""Baselines without a certificate, since they are no constant correction of a model; they run in the evaluation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from ..core import TINY, Array, Columns, ConfigError, DataError, Parameters, Record, SynthesisError, frozen, grouped
from ..data import EpisodeKey, Population
from ..evaluate import error_percent
from ..identify import ModelSet
from ..observer import Screen, Seen, like_measurement_noise, residual_covariance
from ..observer.baselines.difference import FilteredDifference, cutoffs_hz, followed
from ..observer.baselines.extended_kalman import ExtendedKalman, start_covariance
from ..observer.baselines.learned import DEFAULT as RIDGE
from ..observer.baselines.learned import Moments, Regressor, Rows
from .task import Label
from .training import TrainingSet, rank


@frozen
class BaselineSettings:
    """How baselines are tuned and trained."""

    levels: tuple[float, ...] = (-4.0, -2.0, 0.0, 2.0, 4.0)  # decades of the extended filter's process noise
    extended_samples: int = 2_000  # of an episode, on which these are compared
    folds: int = 4  # of units, each estimated by a regression of scikit-learn that does not know it
    same_motion: float = 0.01  # RMS difference of inputs of the same motion, share of the largest input


DEFAULT = BaselineSettings()
BASELINES = {
    "ekf": Label("extended Kalman", "extended Kalman filter", "PURPLE", baseline=True),
    "filtered_difference": Label("filtered difference", "low-pass filtered derivative", "GOLD", baseline=True),
    "learned": Label("learned", "ridge regression on past samples", "GREEN", baseline=True),
    "mean_profile": Label("mean profile", "mean of the same episode of other units", "GREEN", ":", baseline=True),
    "boosting": Label("boosting", "gradient boosting on past samples", "GREEN", "--", baseline=True),
    "network": Label("network", "neural network on past samples", "GREEN", "-.", baseline=True),
}


class BaselineEstimator(Protocol):
    """What can be run over a batch of episodes."""

    def run(self, y: Array, u: Array, parameters: Parameters | None = None) -> Array:
        """Return estimates, shape (n_samples, batch, n)."""


@frozen
class Baseline:
    """A baseline that was tuned or trained."""

    by_unit: Mapping[str, BaselineEstimator]
    measured: Columns
    estimated: Columns
    facts: Record
    seen: Seen | None

    def estimate(self, keys: Sequence[EpisodeKey], y: Array, u: Array, parameters: Mapping[str, Array]) -> Array:
        """Estimate episodes, each with the estimator of its unit; NaN for states that are not estimated."""
        names = [key.unit if key.unit in self.by_unit else "" for key in keys]
        units = grouped(range(len(keys)), names.__getitem__)
        samples, parts = Screen.sized(self.seen, y.shape[-1], u.shape[-1]).take(y, u), list[Array]()
        for unit, rows in units.items():
            values = {k: v[rows] for k, v in parameters.items()}
            parts.append(self.by_unit[unit].run(samples.y[:, rows], samples.u[:, rows], values))
        return np.concatenate(parts, axis=1)[:, np.argsort(np.concatenate(list(units.values())))]


def make_extended(training: TrainingSet, models: ModelSet, unit: str, noise: Array) -> Baseline:
    """Tune the extended Kalman filter of a nominal model: process noise of many sizes, all run side by side."""
    batch, lifting, n = training.read(), models.lifting, models.lifting.n_states
    row, C, R = models.index(unit), list(models.measured), np.diag(noise**2)
    shape = residual_covariance(lifting, models.A[row], models.B[row], batch)
    shape = shape * like_measurement_noise(shape[np.ix_(C, C)], R)
    filters = ExtendedKalman(
        lifting,
        models.A[row],
        models.B[row],
        models.measured,
        np.stack([10**level * shape for level in DEFAULT.levels]),
        R,
        start_covariance(models.output_scale[:n], R, models.measured),
        models.parameters_of(unit),
        training.runtime,
    )
    short = batch.head(DEFAULT.extended_samples)
    estimates = filters.run_all(short.measurements(models.measured), short.inputs, short.parameters)
    percents = [error_percent(estimate, short.states, short.lengths).mean(axis=0) for estimate in estimates]
    ranks = [rank(np.where(np.isfinite(p), p, np.inf), np.full(n, 100.0), models.measured) for p in percents]
    first = ranks.index(min(ranks))
    if not np.isfinite(ranks[first][1]):
        raise SynthesisError("Extended Kalman filter: every candidate diverges on the training episodes.")
    facts = {"status": "tuned", "process_noise_level": 10 ** DEFAULT.levels[first]}
    tuned = {"": replace(filters, Q=filters.Q[first])}
    return Baseline(tuned, models.measured, tuple(range(n)), facts, training.seen)


def make_difference(training: TrainingSet, measured: Columns) -> Baseline:
    """Choose the cut-off of the filtered difference and find its scale."""
    population, batch = training.population, training.read()
    y, period = batch.measurements(measured), population.sample_period_s
    pairs = followed(batch, measured)
    if not pairs:
        raise ConfigError(
            f"Filtered difference: no state of {', '.join(population.states)} follows the rate of a measured one; "
            "record the rate."
        )
    estimated = tuple(state for _, state in pairs)
    plain = (FilteredDifference(len(population.states), pairs, float(cutoff), period) for cutoff in cutoffs_hz(period))
    trials = [trial.scaled_to(batch, measured) for trial in plain]
    estimates = [trial.run(y, batch.inputs)[..., estimated] for trial in trials]
    errors = [error_percent(one, batch.states[..., estimated], batch.lengths).mean() for one in estimates]
    best = trials[int(np.argmin(errors))]
    facts = {"status": "tuned", "cutoff_hz": best.cutoff_hz}
    return Baseline({"": best}, measured, estimated, facts, training.seen)


def make_learned(training: TrainingSet, measured: Columns) -> Baseline:
    """Train the learned estimator on whole training episodes of all units, once for every unit without it."""
    samples = len(training.population.read(training.keys[0])) * len(training.keys)
    step = max(1, samples // RIDGE.rows)
    moments = Moments.of(training.one_by_one(), measured, step)
    facts = {"status": "trained", "episodes": len(training.keys), "left_out": "the unit under test"}
    estimators = {unit: moments.estimator([unit]) for unit in moments.units} | {"": moments.estimator()}
    return Baseline(estimators, measured, moments.estimated, facts, training.seen)


def make_trained(training: TrainingSet, measured: Columns, kind: Regressor) -> Baseline:
    """Train a regression of scikit-learn on whole training episodes of all units, and without each fold of them."""
    lengths = [len(batch.states) for batch in training.one_by_one()]
    rows = Rows.of(training.one_by_one(), measured, lengths)
    units, of_all = sorted(training.parameters), rows.fitted(kind)
    folds = [units[k :: DEFAULT.folds] for k in range(min(DEFAULT.folds, len(units)))]
    by_unit = {unit: one for fold in folds for one in [rows.fitted(kind, fold)] for unit in fold} | {"": of_all}
    facts = {"status": "trained", "episodes": len(training.keys), "left_out": "units of the fold under test"}
    return Baseline(by_unit, measured, tuple(of_all.regressors), facts, training.seen)


def nearest(motions: Sequence[Array], u: Array) -> tuple[int, float]:
    """Return the motion whose inputs have the least RMS difference from some, and that over the largest."""
    sizes = np.max([np.abs(motion).max(axis=0) for motion in (*motions, u)], axis=0)
    squares = (np.mean((u[: len(motion)] - motion[: len(u)]) ** 2, axis=0) for motion in motions)
    apart = [float((np.sqrt(square) / np.maximum(sizes, TINY)).max()) for square in squares]
    return apart.index(min(apart)), min(apart)


@frozen
class MeanProfile:
    """Mean states of motions, for machines that repeat a motion."""

    n_states: int
    estimated: Columns
    motions: Sequence[Array]  # the inputs of each, (n_samples, m)
    states: Sequence[Array]  # (n_samples, h)

    def run(self, y: Array, u: Array, parameters: Parameters | None = None) -> Array:
        """Estimate a batch from its first sample on, each member by the motion whose inputs are nearest."""
        del parameters
        estimate = np.full((*y.shape[:2], self.n_states), np.nan)
        for i in range(y.shape[1]):
            states = self.states[nearest(self.motions, u[:, i])[0]]
            estimate[:, i, list(self.estimated)] = held(states, len(y))
        return estimate


def held(signal: Array, n_samples: int) -> Array:
    """Return a signal, shape (n, ...), of `n_samples` samples: cut, or held at its last one."""
    return signal[np.minimum(np.arange(n_samples), len(signal) - 1)]


def make_mean_profile(
    training: TrainingSet, measured: Columns, population: Population, keys: Iterable[EpisodeKey]
) -> Baseline:
    """Average the states of training episodes that have the same motions, over units, and without each unit."""
    n = len(population.states)
    estimated = tuple(i for i in range(n) if i not in measured)
    if not population.inputs or not estimated:
        raise DataError("Mean profile: it needs inputs that identify a motion, and a state that is not measured.")
    known = different_motions(population, keys)
    motions = list(known.values())
    means = unit_means(training, motions, estimated)
    for key, of_units in zip(known, means, strict=True):
        if len(of_units) < 2:
            raise DataError(
                f"Mean profile: the inputs of held-out {key} do not occur in training episodes of two units; they may "
                f"differ by {100 * DEFAULT.same_motion:g} % of the largest (RMS)."
            )

    def without(left_out: str) -> MeanProfile:
        states = [np.mean([p for unit, p in of_units.items() if unit != left_out], axis=0) for of_units in means]
        return MeanProfile(n, estimated, motions, states)

    by_unit = {unit: without(unit) for unit in set[str]().union([""], *means)}
    facts = {"status": "averaged", "motions": len(known), "left_out": "the unit under test"}
    return Baseline(by_unit, measured, estimated, facts, training.seen)


def different_motions(population: Population, keys: Iterable[EpisodeKey]) -> dict[EpisodeKey, Array]:
    """Return the inputs of episodes that differ, (n_samples, m) each."""
    motions = dict[EpisodeKey, Array]()
    for key in keys:
        u = population.read_parts(key)[1]
        if not motions or nearest(list(motions.values()), u)[1] > DEFAULT.same_motion:
            motions[key] = u
    return motions


def unit_means(training: TrainingSet, motions: Sequence[Array], estimated: Columns) -> list[dict[str, Array]]:
    """Return the mean states of every motion by unit."""
    profiles: list[dict[str, list[Array]]] = [{} for _ in motions]
    for part in training.one_by_one():
        at, apart = nearest(motions, part.inputs[:, 0])
        if apart <= DEFAULT.same_motion:
            states = held(part.states[:, 0, list(estimated)], len(motions[at]))
            profiles[at].setdefault(part.units[0], []).append(states)
    return [{unit: np.mean(some, axis=0) for unit, some in one.items()} for one in profiles]
