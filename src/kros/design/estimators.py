"""Baselines that are no constant correction of a model, and so have no certificate: made and run where observers are evaluated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, SynthesisError
from ..data import EpisodeBatch
from ..data.population import EpisodeKey
from ..evaluate import error_percent
from ..evaluate.disturb import hold_missing
from ..identify import ModelSet
from ..observer import ExtendedKalman, FilteredDifference, Seen
from ..observer.baselines.difference import cutoffs_hz, followed
from ..observer.baselines.extended_kalman import start_covariance
from ..observer.baselines.kalman import like_measurement_noise
from ..observer.baselines.learned import Moments, Ridge
from ..observer.residual.one_step import one_step_covariance, one_step_residual
from ..observer.screen import Screen, Screened
from ..observer.sensor import delay_of
from .methods.gains import EQUAL, RESIDUAL
from .validation import TrainingSet, rank

Array = npt.NDArray[np.float64]
Parameters = Mapping[str, Array]
_LEVELS = (-4.0, -2.0, 0.0, 2.0, 4.0)  # decades of process noise that the extended filter tries, for either shape
_EXTENDED_SAMPLES = 2_000


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
    takes_missing: bool = False
    restarts: bool = True
    limits: tuple[Array, Array] | None = None
    seen: Seen | None = None

    def run(self, batch: EpisodeBatch, parameters: Parameters) -> Array:
        """Estimate all episodes, each with the estimator of its unit; NaN for states that are not estimated."""
        return self.estimate(batch.keys, batch.measurements(self.measured), batch.inputs, parameters)

    def estimate(self, keys: Sequence[EpisodeKey], y: Array, u: Array, parameters: Parameters) -> Array:
        """Estimate episodes from measurements and inputs of any origin, shape (n_samples, batch, q) and (..., m); not finite where one is missing."""
        pieces: dict[str, list[int]] = {}
        for i, key in enumerate(keys):
            pieces.setdefault(key.unit if key.unit in self.by_unit else "", []).append(i)
        samples = Screen.sized(self.seen, y.shape[-1], u.shape[-1]).take(y, u)
        found: Array | None = None
        for name, rows in pieces.items():
            own = {k: v[rows] for k, v in parameters.items()}
            run, mine = partial(self._piece, self.by_unit[name]), samples.of(rows)
            part = restarted(run, mine, own) if self.restarts else run(mine.y, mine.u, own)
            found = np.empty((*y.shape[:2], part.shape[-1])) if found is None else found
            found[:, rows] = part
        assert found is not None
        return found if self.limits is None else np.clip(found, *self.limits)

    def _piece(self, estimator: Estimator, y: Array, u: Array, parameters: Parameters) -> Array:
        return estimator.run(y if self.takes_missing else hold_missing(y), u, parameters)


def restarted(
    run: Callable[[Array, Array, Mapping[str, Any]], Array], samples: Screened, parameters: Mapping[str, npt.ArrayLike]
) -> Array:
    """Run a batch, and every member once more from each sample at which it starts again to the next; shape (n_samples, batch, n)."""
    n_samples, batch = samples.starts.shape
    found = run(samples.y, samples.u, parameters)
    for begin in np.flatnonzero(samples.starts[1:].any(axis=1)) + 1:
        own = np.flatnonzero(samples.starts[begin])
        again = samples.starts[begin + 1 :, own]
        lasts = np.where(again.any(axis=0), begin + 1 + again.argmax(axis=0), n_samples - 1) if len(again) else begin
        rows = slice(begin, int(np.max(lasts)) + 1)
        part = {name: np.broadcast_to(np.asarray(v, dtype=float), (batch,))[own] for name, v in parameters.items()}
        found[begin + 1 : rows.stop, own] = run(samples.y[rows, own], samples.u[rows, own], part)[1:]
    return found


def make_extended(training: TrainingSet, models: ModelSet, unit: str, noise: Array) -> Baseline:
    """Tune the extended Kalman filter of a nominal model: process noise over eight decades, of two shapes, all run side by side."""
    data, lifting, n = training.read(), models.lifting, models.lifting.n_states
    row, C, R = models.index(unit), list(models.measured), np.diag(noise**2)
    batch = data.batch
    residual = one_step_residual(lifting, models.A[row], models.B[row], batch.states, batch.inputs, batch.parameters)
    pooled = one_step_covariance(residual, batch.lengths - 1 - lifting.history)
    shapes = {EQUAL: np.diag(models.output_scale[:n] ** 2), RESIDUAL: pooled}
    sized = {name: shape * like_measurement_noise(shape[np.ix_(C, C)], R) for name, shape in shapes.items()}
    tried = [(name, level, 10**level * shape) for name, shape in sized.items() for level in _LEVELS]
    start = start_covariance(models.output_scale[:n], R, models.measured)
    values = {name: float(v[row]) for name, v in models.parameters.items()}
    filters = ExtendedKalman(
        lifting,
        models.A[row],
        models.B[row],
        models.measured,
        models.recorded_inputs,
        np.stack([Q for *_, Q in tried]),
        R,
        start,
        values,
        delay_of(training.sensor),
    )
    short = data.first(_EXTENDED_SAMPLES)
    percents = [
        error_percent(estimate, short.batch.states, short.batch.lengths).mean(axis=0)
        for estimate in filters.run_all(short.measurements(models.measured), short.batch.inputs, short.parameters)
    ]
    bounded = [np.where(np.isfinite(p), p, np.inf) for p in percents]
    limit = np.full(n, 100.0)
    ranks = [rank(p, limit, models.measured) for p in bounded]
    first = min(range(len(tried)), key=lambda i: ranks[i])
    if not np.isfinite(bounded[first]).all():
        raise SynthesisError("Extended Kalman filter: every candidate diverges on the training episodes.")
    shape_name, level, Q = tried[first]
    facts = {"status": "tuned", "process_noise_level": 10**level, "process_noise_shape": shape_name}
    return Baseline(
        {"": replace(filters, Q=Q)}, models.measured, tuple(range(n)), facts, takes_missing=True, seen=training.seen
    )


def make_difference(training: TrainingSet, measured: tuple[int, ...]) -> Baseline:
    """Choose the cut-off of the filtered difference and find its scale."""
    population, data = training.population, training.read()
    states, y, lengths = data.batch.states, data.measurements(measured), data.batch.lengths
    pairs = followed(data.batch, measured)
    if not pairs:
        raise ConfigError(
            f"Filtered difference: no state of {', '.join(population.states)} follows the rate of a measured one; record the rate."
        )
    estimated = [state for _, state in pairs]
    truth = states[..., estimated]
    best: tuple[float, FilteredDifference] | None = None
    for cutoff in cutoffs_hz(population.sample_period_s):
        trial = FilteredDifference(len(population.states), pairs, float(cutoff), population.sample_period_s).scaled_to(
            data.batch, measured
        )
        error = float(error_percent(trial.run(y, data.batch.inputs)[..., estimated], truth, lengths).mean())
        if best is None or error < best[0]:
            best = (error, trial)
    assert best is not None
    return Baseline(
        {"": best[1]},
        measured,
        tuple(estimated),
        {"status": "tuned", "cutoff_hz": best[1].cutoff_hz},
        seen=training.seen,
    )


def make_learned(training: TrainingSet, measured: tuple[int, ...]) -> Baseline:
    """Train the learned estimator on whole training episodes of all units, once for every unit without it."""
    samples = len(training.population.read(training.keys[0])) * len(training.keys)
    step = max(1, samples // Ridge().rows)
    moments = Moments.of((part.batch for part in training.one_by_one()), measured, step)
    facts = {"status": "trained", "episodes": len(training.keys), "left_out": "the unit under test"}
    estimators = {unit: moments.estimator([unit]) for unit in moments.units} | {"": moments.estimator()}
    return Baseline(estimators, measured, moments.estimated, facts, seen=training.seen)
