"""What training says of gaps: how fast the fallback forgets, and from which age on it is better than the filters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ..filter_bank import FilterBank
from ..observer import Observer
from ..simulate import run_observer
from .regression import Recordings
from .settings import EstimatorSettings

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
_NEVER = 1e12  # samples: an age that no gap has


def training(
    recordings: Recordings, settings: EstimatorSettings, count: int
) -> tuple[Array, Array, Array, dict[str, Array]]:
    """Return states, measurements, inputs and parameters of some episodes side by side, cut to one length."""
    some = recordings.some(count)
    length = min(min(some.lengths), settings.gap_samples)
    batches = [recordings.read(key) for key in some.keys]
    states, inputs = (
        np.concatenate([getattr(b, what)[:length] for b in batches], axis=1) for what in ("states", "inputs")
    )
    shown = np.concatenate([b.measurements(range(states.shape[-1]), arrived=False)[:length] for b in batches], axis=1)
    names = batches[0].parameters
    return states, shown, inputs, {k: np.concatenate([b.parameters[k] for b in batches]) for k in names}


def forgetting(apart: Array) -> Array:
    """Return the factors (n,) by which distances (n_samples, batch, n) from the estimate of inputs alone decay."""
    lags = np.unique(np.geomspace(1, max(2, len(apart) // 4), 12).round().astype(int))
    rhos = np.append(np.exp(-1 / np.geomspace(1, 4 * len(apart), 40)), 1.0)
    score = np.zeros((len(rhos), apart.shape[-1]))
    for lag in lags:
        now, later = apart[:-lag], apart[lag:]
        a, b, c = (np.mean(x, axis=(0, 1)) for x in (later * later, later * now, now * now))
        error = a - 2 * np.outer(rhos**lag, b) + np.outer(rhos ** (2 * lag), c)
        score += np.log(np.maximum(error, 1e-300))
    return rhos[np.argmin(score, axis=0)]


def losses(rng: np.random.Generator, n_samples: int, batch: int) -> Flags:
    """Return samples (n_samples, batch) that are missing: independently, or in gaps of log-uniform lengths."""
    missing = np.zeros((n_samples, batch), dtype=bool)
    for i in range(batch):
        if i % 2:
            lengths = np.exp(rng.uniform(0, np.log(max(2, n_samples / 2)), n_samples)).astype(int)
            missing[1:, i] = np.repeat(np.arange(n_samples) % 2 == 1, lengths)[: n_samples - 1]
        else:
            missing[1:, i] = rng.random(n_samples - 1) < rng.uniform(0.1, 0.95)
    return missing


def with_gaps(observer: Observer, recordings: Recordings, settings: EstimatorSettings) -> FilterBank:
    """Return the filter bank with forgetting and ages of gaps that minimise errors under simulated losses."""
    bank = observer.bank
    assert bank is not None
    states, shown, inputs, parameters = training(recordings, settings, settings.gap_episodes)
    n, at = len(observer.recorded), list(observer.measured)
    longest = settings.blocks(recordings.length)[-1]
    missing = losses(np.random.default_rng(settings.seed), *shown.shape[:2])
    half = np.full(n, _NEVER)
    half[at] = settings.half * longest
    y, own = shown[..., at], observer.own(parameters)
    forget = forgetting(states - run_observer(observer, y, inputs, own)[..., -n:])
    recovery = np.exp(-1 / (longest * np.array(settings.recoveries)))
    bank = replace(bank, forget=forget, half=half)
    lost = np.where(missing[..., None], np.nan, y)
    estimates = run_observer(replace(observer, bank=bank), lost, inputs, own)
    T, mu = (grid.reshape(-1, 1) for grid in np.meshgrid(longest * np.array(settings.halves), recovery))
    errors = blended_errors(states, estimates[..., :n], estimates[..., -n:], missing, forget, T, mu)
    best = np.argmin(errors, axis=0)
    half, recovery = np.where(half == _NEVER, T[best, 0], half), mu[best, 0]
    return replace(bank, half=half, recovery=recovery)


def blended_errors(
    states: Array, filtered: Array, from_inputs: Array, missing: Flags, forget: Array, half: Array, recovery: Array
) -> Array:
    """Return mean log squared errors (c, n) for candidates of half and recovery (c, 1), see `Gaps.follow`."""
    count, age = np.zeros(missing.shape[1]), np.zeros((len(half), missing.shape[1]))
    x, squares = np.repeat(filtered[:1], len(half), axis=0), np.zeros((len(half), *states.shape[1:]))
    for k, lost in enumerate(missing[:-1]):
        count = np.where(lost, count + 1, 0.0)
        age = np.maximum(np.where(lost, age, recovery * age), count)
        level = (age**2 / (age**2 + half**2))[..., None]
        fallback = from_inputs[k + 1] + forget * (x - from_inputs[k])
        x = filtered[k + 1] + level * (fallback - filtered[k + 1])
        squares += (x - states[k + 1]) ** 2
    return np.log(squares / len(missing) + np.finfo(float).tiny).mean(axis=1)
