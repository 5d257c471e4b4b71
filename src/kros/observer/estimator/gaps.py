"""What training says of gaps: how fast a fallback forgets, and when it is better than the filters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ..filter_bank import FilterBank
from ..observer import Observer
from ..step import Steps
from .regression import Recordings
from .settings import EstimatorSettings

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


def training(
    recordings: Recordings, settings: EstimatorSettings, count: int
) -> tuple[Array, Array, Array, dict[str, Array]]:
    """Return states, measurements and inputs of some episodes side by side, cut to one length, with their parameters."""
    some = recordings.some(count)
    length = min(min(some.lengths), settings.gap_samples)
    batches = [recordings.read(key) for key in some.keys]
    states, inputs = (
        np.concatenate([getattr(b, what)[:length] for b in batches], axis=1) for what in ("states", "inputs")
    )
    shown = np.concatenate([b.measurements(range(states.shape[-1]), arrived=False)[:length] for b in batches], axis=1)
    names = batches[0].parameters
    return states, shown, inputs, {k: np.concatenate([b.parameters[k] for b in batches]) for k in names}


def forgetting(observer: Observer, recordings: Recordings, settings: EstimatorSettings) -> Array:
    """Return the factor rho of every recorded state by which its distance from the estimate of inputs alone persists from sample to sample."""
    from ..simulate import run_observer

    states, shown, inputs, parameters = training(recordings, settings, settings.gap_episodes)
    n, at = len(observer.recorded), list(observer.measured)
    estimates = run_observer(observer, shown[..., at], inputs, observer.own(parameters))
    apart = states - estimates[..., -n:]
    lags = np.unique(np.geomspace(1, max(2, len(states) // 4), 12).round().astype(int))
    rhos = np.append(np.exp(-1 / np.geomspace(1, 4 * len(states), 40)), 1.0)
    score = np.zeros((len(rhos), n))
    for lag in lags:
        now, later = apart[:-lag], apart[lag:]
        a, b, c = (np.mean(x, axis=(0, 1)) for x in (later * later, later * now, now * now))
        error = a - 2 * np.outer(rhos**lag, b) + np.outer(rhos ** (2 * lag), c)
        score += np.log(np.maximum(error, 1e-300))
    return rhos[np.argmin(score, axis=0)]


def losses(rng: np.random.Generator, shape: tuple[int, int, int]) -> Flags:
    """Return which measurements are missing: independent or in bursts, differing from episode to episode; half of the time all arrive."""
    n_samples, batch, _ = shape
    missing = np.zeros(shape, dtype=bool)
    for i in range(batch):
        share, mean = rng.choice([0.1, 0.3, 0.5, 0.7, 0.9]), np.exp(rng.uniform(0, np.log(max(2, n_samples / 4))))
        state = False
        leave = 1 / max(mean, 1 / (1 - share)) if i % 2 else 1 - share
        enter = leave * share / (1 - share) if i % 2 else share
        chance = rng.random(n_samples)
        for k in range(1, n_samples):
            state = bool(chance[k] >= leave) if state else bool(chance[k] < min(enter, 1.0))
            missing[k, i] = state
        quiet = np.arange(n_samples) % max(8, n_samples // 4) < max(2, n_samples // 16)
        missing[quiet, i] = False
    return missing


def with_gaps(observer: Observer, recordings: Recordings, settings: EstimatorSettings) -> FilterBank:
    """Return the filter bank with the forgetting, level and shares that make errors under simulated losses least."""
    bank = observer.bank
    assert bank is not None
    states, shown, inputs, parameters = training(recordings, settings, settings.gap_episodes)
    n, at = len(observer.recorded), list(observer.measured)
    missing = losses(np.random.default_rng(settings.seed), shown[..., at].shape)
    y = np.where(missing, np.nan, shown[..., at])
    levels = np.append(0.0, np.geomspace(settings.lowest_level, 1.0, settings.levels))
    bank = replace(
        bank, forget=forgetting(observer, recordings, settings), levels=levels, shares=np.zeros((len(levels), n))
    )
    tried = []
    recovery = float(np.exp(-1 / max(1.0, settings.recovery * settings.longest)))
    for half in settings.halves:
        one = replace(bank, half=half * settings.longest, recovery=recovery)
        main, fallback, level = alternatives(replace(observer, bank=one), y, inputs, parameters)
        shares = best_shares(states, main, fallback, level, levels)
        shares[:, at] = 0.0  # they stand for measurements, near the fallback
        one = replace(one, shares=shares)
        estimate = main + one.share(level) * (fallback - main)
        error = np.mean((estimate - states)[level > 0] ** 2, axis=0)
        tried.append((float(np.log(np.maximum(error, np.finfo(float).tiny)).mean()), one))
    return min(tried, key=lambda pair: pair[0])[1]


def alternatives(observer: Observer, y: Array, u: Array, parameters: dict[str, Array]) -> tuple[Array, Array, Array]:
    """Return what the filters and the fallback estimate under losses, (n_samples, batch, n) each, and the level (n_samples, batch)."""
    n, batch = len(observer.recorded), y.shape[1]
    steps = Steps(observer, batch, observer.values(observer.own(parameters), (batch,)))
    steps.begin(y[0], u=u[0])
    main, fallback, level = np.zeros((len(y), batch, n)), np.zeros((len(y), batch, n)), np.zeros((len(y), batch))
    main[0] = fallback[0] = steps.x[:, :n]
    for k in range(len(y) - 1):
        main[k + 1], fallback[k + 1], level[k + 1] = steps.alternatives(y[k], u[k])
    return main, fallback, level


def best_shares(states: Array, main: Array, fallback: Array, level: Array, levels: Array) -> Array:
    """Return shares between zero and one, none at level zero, that make ``main + beta(level) (fallback - main)`` closest to the states."""
    hats = np.maximum(0.0, np.array([np.interp(level, levels, row) for row in np.eye(len(levels))[1:]]))
    found = np.zeros((len(levels), states.shape[-1]))
    for j in range(states.shape[-1]):
        apart = fallback[..., j] - main[..., j]
        X = (hats * apart).reshape(len(hats), -1)
        t = (states[..., j] - main[..., j]).reshape(-1)
        gram = X @ X.T
        found[1:, j] = np.linalg.solve(
            gram + 1e-9 * np.trace(gram) * np.eye(len(gram)) + 1e-300 * np.eye(len(gram)), X @ t
        )
    return np.clip(found, 0.0, 1.0)
