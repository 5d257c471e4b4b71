"""What training says of gaps: how good estimates of measurements are, and where the fallback is better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...core import EPS, ITERATED, TINY, Array, Flags, Parameters
from ...core.linalg import pieces
from ..filter_bank import FilterBank
from ..observer import Observer
from ..simulate import Course
from .rows import Recordings
from .settings import EstimatorSettings

_FAR = 1e9  # errors at which the fallback counts one half, where it never does
_ROWS = 1000  # samples at a time


def training(
    observer: Observer, recordings: Recordings, samples: int, patterns: int, longest: int
) -> tuple[Array, Array, Array, Parameters]:
    """Return states, measurements, inputs and parameters of some episodes side by side, cut to one length."""
    length = min(longest, samples // patterns)
    count = samples // length
    batches = [recordings.read(key).head(length) for key in recordings.some(count).keys]
    again = np.arange(count) % len(batches)  # every episode is seen with several losses
    signals = ((b.states, b.measurements(observer.measured, arrived=False), b.inputs) for b in batches)
    states, y, inputs = (np.concatenate(parts, axis=1)[:, again] for parts in zip(*signals, strict=True))
    names = batches[0].parameters
    own = observer.own({k: np.concatenate([b.parameters[k] for b in batches])[again] for k in names})
    return states, y, inputs, own


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


def with_errors(observer: Observer, recordings: Recordings, settings: EstimatorSettings) -> FilterBank:
    """Return the observer's bank with errors of one step, gates, doubts at a start, and the fallback's RMS errors.

    Gates, b, w and d, are several times the largest distances of measurements from their estimates in training, of
    starts amid its episodes too, where d is by the first step; and `rest` is several times the largest of the first
    step of its episodes. The fallback's errors stand in `half`.
    """
    assert observer.bank is not None
    bank, n, at = observer.bank, len(observer.recorded), list(observer.measured)
    some = -(-settings.gap_samples // settings.folds), -(-settings.gap_episodes // settings.folds)
    states, y, inputs, own = training(observer, recordings, *some, min(recordings.lengths))
    estimates, z = whole_estimates(observer, y, inputs, own), slice(n, n + bank.filters)
    start = min(bank.patience, len(y) // 2)
    began = observer.initial(y[start:], own, inputs[start:])[..., z]
    unknown = (estimates[start:][..., z] - began).reshape(-1, bank.filters)
    low, high = (end[:n] for end in recordings.ranges)
    size = np.where(high > low, high - low, 1.0)
    fallback = np.sqrt(np.mean((states - estimates[..., -n:]) ** 2, axis=(0, 1)))
    apart = abs(y - estimates[..., at])[start:]
    noise, largest = np.sqrt(np.mean(apart**2, axis=(0, 1))), apart.max(axis=(0, 1))
    largest[largest == 0] = np.inf
    noise, half = np.maximum(noise, ITERATED * size[at]), np.maximum(fallback, ITERATED * size)
    rest = settings.gate * np.maximum(abs(y - estimates[..., at])[1].max(axis=0), noise)
    doubt, gate = unknown.T @ unknown / len(unknown), settings.gate * largest
    known = replace(bank, doubt=doubt, half=half, noise=noise, rest=rest, gate=gate, opening=np.full(len(at), 1 / EPS))
    count = len(y) // start
    shown, inputs = (np.hstack(np.split(v[: count * start], count)) for v in (y, inputs))
    again = {name: np.tile(values, count) for name, values in own.items()}
    estimates = whole_estimates(replace(observer, bank=known), shown, inputs, again)
    apart, unsure = abs(shown - estimates[..., at])[1:], estimates[1:, :, -2 * n : -n][..., at]
    deviations = (apart[0] / np.maximum(unsure[0], noise)).max(axis=0)
    begun = (apart - deviations * unsure).max(axis=1) / largest
    opening = ((begun - 1) * np.arange(2, start + 1)[:, None]).max(axis=0, initial=0.0)
    return replace(known, opening=opening, deviations=settings.gate * deviations)


def with_fallback(
    bank: FilterBank, trials: Sequence[tuple[Observer, Recordings]], settings: EstimatorSettings
) -> FilterBank:
    """Return a filter bank with the errors h that suit all simulated losses of trials best.

    Errors count by their ratios to the least of any h in the same loss, by mean squares of logarithms, so that gaps of
    all lengths do; trials do not know their recordings. Of several measurements, some or all are lost.
    """
    rng, squares = np.random.default_rng(settings.seed), list[list[Array]]()
    samples, patterns = (-(-each // len(trials)) for each in (settings.gap_samples, settings.gap_episodes))
    longest = min(min(recordings.lengths) for _, recordings in trials)
    for trial, recordings in trials:
        assert trial.bank is not None
        states, y, inputs, own = training(trial, recordings, samples, patterns, longest)
        _, batch, q = y.shape
        lost = losses(rng, len(y), batch)[..., None] & (
            rng.permuted(np.tile(np.arange(q), (batch, 1)), axis=1) < rng.integers(1, q + 1, (batch, 1))
        )
        shown = np.where(lost, np.nan, y)
        n = states.shape[2]
        alone = replace(trial, bank=replace(trial.bank, noise=bank.noise, half=_FAR * bank.half))
        estimates = whole_estimates(alone, shown, inputs, own)
        x, error, from_inputs = estimates[..., :n], estimates[..., -2 * n : -n], estimates[..., -n:]
        weights = (error**2 / (error**2 + (half * bank.half) ** 2) for half in settings.halves)
        squares.append([np.mean((x + m * (from_inputs - x) - states) ** 2, axis=0) for m in weights])
    logs = np.log(np.maximum(np.concatenate(squares, axis=1), TINY))
    best = ((logs - logs.min(axis=0)) ** 2).mean(axis=1).argmin(axis=0)
    return replace(bank, half=np.array(settings.halves)[best] * bank.half)


def whole_estimates(observer: Observer, y: Array, u: Array, parameters: Parameters) -> Array:
    """Return the estimates of all states, internal ones too, (n_samples, batch, states)."""
    course = Course(observer, y.shape[1], parameters)
    return np.concatenate([course.take(y[k], u[k]).estimates for k in pieces(len(y), _ROWS)])
