"""What training says of gaps: how fast the fallback forgets, and from which age on it is better than the filters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...core import TINY, Array, Flags, Parameters, Whole
from ..filter_bank import FilterBank, longest_age
from ..observer import Observer
from ..simulate import Course
from .regression import Recordings, is_less
from .settings import EstimatorSettings

_NEVER = 1e12  # samples: an age that no gap has
_ROWS = 1000  # samples at a time


def training(
    recordings: Recordings, at: Sequence[int], settings: EstimatorSettings
) -> tuple[Array, Array, Array, dict[str, Array]]:
    """Return states, measurements, inputs and parameters of some episodes side by side, cut to one length."""
    length = min(min(recordings.lengths), settings.gap_samples // settings.gap_episodes)
    count = settings.gap_samples // length
    batches = [recordings.read(key).head(length) for key in recordings.some(count).keys]
    again = np.arange(count) % len(batches)  # every episode is seen with several losses
    signals = (
        [b.states for b in batches],
        [b.measurements(at, arrived=False) for b in batches],
        [b.inputs for b in batches],
    )
    states, y, inputs = (np.concatenate(parts, axis=1)[:, again] for parts in signals)
    names = batches[0].parameters
    return states, y, inputs, {k: np.concatenate([b.parameters[k] for b in batches])[again] for k in names}


def forgetting(apart: Array) -> Array:
    """Return the factors (n,) by which distances (n_samples, batch, n) from the estimate of inputs alone decay."""
    lags = np.unique(np.geomspace(1, max(2, len(apart) // 4), 12).round().astype(int))
    rhos = np.append(np.exp(-1 / np.geomspace(1, 4 * len(apart), 40)), 1.0)
    score = np.zeros((len(rhos), apart.shape[-1]))
    for lag in lags:
        now, later = apart[:-lag], apart[lag:]
        a, b, c = (np.mean(x, axis=(0, 1)) for x in (later * later, later * now, now * now))
        error = a - 2 * np.outer(rhos**lag, b) + np.outer(rhos ** (2 * lag), c)
        score += np.log(np.maximum(error, TINY))
    return rhos[np.argmin(score, axis=0)]


def losses(rng: np.random.Generator, n_samples: int, batch: int) -> Flags:
    """Return samples (n_samples, batch) that are missing: independently, or in gaps of log-uniform lengths."""
    missing = np.zeros((n_samples, batch), dtype=bool)
    shares = np.linspace(0.1, 0.95, -(-batch // 2))
    for i in range(batch):
        if i % 2:
            lengths = np.exp(rng.uniform(0, np.log(max(2, n_samples / 2)), n_samples)).astype(int)
            missing[1:, i] = np.repeat(np.arange(n_samples) % 2 == 1, lengths)[: n_samples - 1]
        else:
            missing[1:, i] = rng.random(n_samples - 1) < shares[i // 2]
    return missing


def with_gaps(
    bank: FilterBank, trial: Observer, recordings: Recordings, settings: EstimatorSettings, held: Sequence[int]
) -> FilterBank:
    """Return a filter bank with forgetting and ages of gaps that minimise a trial's errors under simulated losses.

    The trial does not know the recordings. Ages of measured states change what the filters see: some are tried side by
    side, with the best of the others for each. A larger one, with which the filters go on by themselves for longer, has
    to be better by the margin. Fallbacks of states `held` go on from their last value by themselves.
    """
    n, at = len(trial.recorded), list(trial.measured)
    states, y, inputs, parameters = training(recordings, at, settings)
    batch, own = states.shape[1], trial.own(parameters)
    hidden = [i for i in range(n) if i not in at]
    missing = losses(np.random.default_rng(settings.seed), *y.shape[:2])
    forget = forgetting(states - recorded_estimates(trial, y, inputs, own)[..., n:])
    forget[list(held)] = 0.0
    longest = settings.blocks(recordings.length)[-1]
    halves, recoveries = longest * np.array(settings.halves), np.exp(-1 / (longest * np.array(settings.recoveries)))
    tried = halves[::2]
    ages = np.full((len(tried), batch, n), _NEVER)
    ages[..., at] = tried[:, None, None]
    assert trial.bank is not None
    side = replace(trial.bank, forget=forget, half=ages.reshape(-1, n), recovery=np.zeros(n))
    shown, u = (np.tile(s, (1, len(tried), 1)) for s in (np.where(missing[..., None], np.nan, y), inputs))
    several = {name: np.tile(values, len(tried)) for name, values in own.items()}
    estimates = recorded_estimates(replace(trial, bank=side), shown, u, several)
    T, mu = (grid.reshape(-1, 1) for grid in np.meshgrid(halves, recoveries))
    some = hidden or at
    truth, lost = np.tile(states[..., some], (1, len(tried), 1)), np.tile(missing, (1, len(tried)))
    filtered, fallback = (np.ascontiguousarray(part[..., some]) for part in (estimates[..., :n], estimates[..., n:]))
    every = blended_errors(truth, filtered, fallback, lost, forget[some], T, mu)
    least, best = np.full(batch, np.inf), bank
    for age, errors in zip(tried, np.split(every, len(tried), axis=1), strict=True):
        choice = earliest(errors, T[:, 0], settings.margin)
        score = errors[choice, :, range(len(some))].mean(axis=0)
        if age == tried[0] or is_less(score, least, settings.margin):
            half, recovery = np.full(n, age), np.zeros(n)
            if hidden:
                half[hidden], recovery[hidden] = T[choice, 0], mu[choice, 0]
            least, best = score, replace(bank, forget=forget, half=half, recovery=recovery)
    return best


def recorded_estimates(observer: Observer, y: Array, u: Array, parameters: Parameters) -> Array:
    """Return the estimates and the fallback of recorded states, (n_samples, batch, 2 n), without the filters."""
    course, n = Course(observer, y.shape[1], parameters), len(observer.recorded)
    some = [*range(n), *range(-n, 0)]
    starts = range(0, len(y), _ROWS)
    return np.concatenate([course.take(y[k : k + _ROWS], u[k : k + _ROWS]).estimates[..., some] for k in starts])


def earliest(errors: Array, half: Array, margin: float) -> Whole:
    """Return for every state of errors (c, batch, n) the best of least half within paired standard errors."""
    mean = errors.mean(axis=1)
    apart = errors - np.take_along_axis(errors, np.argmin(mean, axis=0)[None, None], axis=0)
    error = apart.std(axis=1, ddof=1) / np.sqrt(errors.shape[1]) if errors.shape[1] > 1 else 0.0
    alike = apart.mean(axis=1) <= margin * error
    least = np.where(alike, half[:, None], np.inf).min(axis=0)
    return np.argmin(np.where(alike & (half[:, None] == least), mean, np.inf), axis=0)


def blended_errors(
    states: Array, filtered: Array, from_inputs: Array, missing: Flags, forget: Array, half: Array, recovery: Array
) -> Array:
    """Return log squared errors (c, batch, n) for candidates of half and recovery (c, 1), see `Gaps.follow`."""
    count, age = np.zeros(missing.shape[1]), np.zeros((len(half), missing.shape[1]))
    offset = np.repeat((filtered - from_inputs)[:1], len(half), axis=0)
    x, level, squares = offset + from_inputs[0], *np.zeros((2, *offset.shape))
    for k, lost in enumerate(missing[:-1]):
        count = np.where(lost, count + 1, 0.0)
        age = np.maximum(np.where(lost, age, recovery * np.minimum(age, longest_age(half))), count)
        apart = x - from_inputs[k]
        offset = forget * (apart + level * (offset - apart))
        level = (age**2 / (age**2 + half**2))[..., None]
        fallback = from_inputs[k + 1] + offset
        x = filtered[k + 1] + level * (fallback - filtered[k + 1])
        squares += (x - states[k + 1]) ** 2
    return np.log(squares / len(missing) + TINY)
