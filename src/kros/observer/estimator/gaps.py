"""What training says of gaps: how machines move that are let go, and from which age on the fallback is better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...core import TINY, Array, Flags, Parameters
from ...core.linalg import pieces
from ..filter_bank import OLDEST, FilterBank, level
from ..observer import Observer
from ..simulate import Course
from .rows import Recordings
from .settings import EstimatorSettings

_NEVER = 1e12  # samples: an age that no gap has
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


def decay(apart: Array, judged: Sequence[int]) -> Array:
    """Return the stable matrix (n, n) by which distances (n_samples, batch, n) from estimates of inputs alone decay.

    Of roots of regressions over several lags, it is what predicts some states best over all of these lags.
    """
    n, longest = apart.shape[-1], 4 * len(apart)
    lags = np.unique(np.geomspace(1, max(2, len(apart) // 4), 12).round().astype(int)).tolist()
    pairs = [(apart[lag:].reshape(-1, n), apart[:-lag].reshape(-1, n)) for lag in lags]
    moments = [[one.T @ other / len(one) for one, other in ((a, a), (a, b), (b, b))] for a, b in pairs]

    def missed(F: Array) -> float:
        powers = [np.linalg.matrix_power(F, lag) for lag in lags]
        left = [np.diag(a - 2 * b @ P.T + P @ c @ P.T) for P, (a, b, c) in zip(powers, moments, strict=True)]
        return float(np.log(np.maximum(left, TINY))[:, judged].sum())

    found = []
    for lag, (_, later, now) in zip(lags, moments, strict=True):
        values, modes = np.linalg.eig(later @ np.linalg.pinv(now, hermitian=True))
        roots = np.where((values.imag == 0) & (values.real < 0), 0.0, values) ** (1 / lag)  # gone within the lag
        roots *= np.minimum(1, np.exp(-1 / longest) / np.maximum(abs(roots), TINY))
        found.append((modes * roots @ np.linalg.pinv(modes)).real)
    return min(found, key=missed)


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
    bank: FilterBank, trials: Sequence[tuple[Observer, Recordings]], F: Array, settings: EstimatorSettings
) -> FilterBank:
    """Return a filter bank with the ages that suit all simulated losses of trials best.

    Errors count by their ratios to the least of any ages in the same loss, by mean squares of logarithms, so that gaps
    of all lengths do; trials do not know their recordings. Ages of the fallback come first, then those of the readout
    after losses. What stands for a measurement has that readout at every loss, and is near the fallback always.
    """
    at = list(trials[0][0].measured)
    hidden = [i for i in range(len(F)) if i not in at]
    half = np.full_like(bank.half, _NEVER)
    longest = settings.longest(float(np.median([recordings.length for _, recordings in trials])))
    ages = longest * np.array(settings.halves)
    half[::2, at] = ages[0]
    if not hidden:
        return replace(bank, half=half)
    rng = np.random.default_rng(settings.seed)
    samples, patterns = (-(-each // len(trials)) for each in (settings.gap_samples, settings.gap_episodes))
    length = min(min(recordings.lengths) for _, recordings in trials)
    seen = [training(trial, recordings, samples, patterns, length) for trial, recordings in trials]
    for kind in range(0, len(half), 2):
        runs = []
        for (trial, _), (states, y, inputs, own) in zip(trials, seen, strict=True):
            lost, sensors = losses(rng, *y.shape[:2]), np.ones(y.shape[1:], dtype=bool)
            if kind:
                sensors = rng.permuted(np.arange(len(at)) < rng.integers(1, len(at), (len(sensors), 1)), axis=1)
            assert trial.bank is not None
            side = replace(trial, bank=replace(trial.bank, half=half))
            shown = np.where(lost[..., None] & sensors, np.nan, y)
            estimates = np.split(recorded_estimates(side, shown, inputs, own), 3, axis=-1)
            estimates[0][..., at] = states[..., at]
            runs.append((lost, states, *estimates))
        lost, *signals = (np.concatenate(each, axis=1) for each in zip(*runs, strict=True))
        half[kind, hidden] = ages[0]
        for row in (1, 0):
            candidates = np.repeat(half[kind : kind + 2, None], len(ages), axis=1)
            candidates[row, :, hidden] = ages
            squares = blended_errors(lost, signals, F, replace(bank, half=candidates), at)[..., hidden]
            logs = np.log(np.maximum(squares, TINY))
            half[kind + row, hidden] = ages[((logs - logs.min(axis=0)) ** 2).mean(axis=1).argmin(axis=0)]
    return replace(bank, half=half)


def distances(
    observer: Observer, recordings: Recordings, settings: EstimatorSettings, held: Sequence[int]
) -> tuple[Array, Array, Array, tuple[Array, Array]]:
    """Return how distances from estimates of inputs alone decay and follow measurements, their RMS, and gates.

    States that are `held` have no decay. Gates, b and w, are several times the largest distances of measurements from
    their estimates in training, of starts amid its episodes too.
    """
    assert observer.bank is not None
    n, at = len(observer.recorded), list(observer.measured)
    states, y, inputs, own = training(
        observer, recordings, settings.gap_samples, settings.gap_episodes, min(recordings.lengths)
    )
    apart = states - recorded_estimates(observer, y, inputs, own)[..., 2 * n :]
    start = min(observer.bank.patience, len(y) // 2)
    count = len(y) // start
    shown, inputs = (np.hstack(np.split(v[: count * start], count)) for v in (y, inputs))
    again = {name: np.tile(values, count) for name, values in own.items()}
    largest = abs(shown - recorded_estimates(observer, shown, inputs, again)[..., at]).max(axis=1)
    usual = largest[start // 2 :].max(axis=0)
    usual[usual == 0] = np.inf
    opening = ((largest / usual - 1) * np.arange(1, start + 1)[:, None]).max(axis=0, initial=0.0)
    F = decay(apart, [i for i in range(n) if i not in at] or at)
    F[held], F[:, held] = 0.0, 0.0
    rms = np.sqrt(np.mean(apart**2, axis=(0, 1)))
    return F, pull_of(F, apart, rms, at), rms, (settings.gate * usual, opening)


def pull_of(F: Array, apart: Array, rms: Array, measured: list[int]) -> Array:
    """Return by how much distances follow those of measurements, (n, q): their regression, by a covariance X.

    ``F X F' <= X``, so that F and the correction are contractions in one norm: by turns, they let no distance grow.
    """
    from scipy.linalg import solve_discrete_lyapunov

    size = np.where(rms > 0, rms, 1.0)
    one, step = (apart / size).reshape(-1, len(F)), F * size / size[:, None]
    now = one.T @ one / len(one)
    values, modes = np.linalg.eigh(now - step @ now @ step.T)
    X = solve_discrete_lyapunov(step, (modes * np.maximum(values, 0.0)) @ modes.T)
    pull = X[:, measured] @ np.linalg.pinv(X[np.ix_(measured, measured)], hermitian=True)
    return pull * size[:, None] / size[measured]


def recorded_estimates(observer: Observer, y: Array, u: Array, parameters: Parameters) -> Array:
    """Return the estimates of recorded states, those after a loss and from inputs alone, (n_samples, batch, 3 n)."""
    course, n = Course(observer, y.shape[1], parameters), len(observer.recorded)
    some = [*range(n), *range(-3 * n, -n)]
    return np.concatenate([course.take(y[k], u[k]).estimates[..., some] for k in pieces(len(y), _ROWS)])


def blended_errors(missing: Flags, signals: Sequence[Array], F: Array, bank: FilterBank, measured: list[int]) -> Array:
    """Return mean squared errors (c, batch, n) of candidates of half in a bank, (2, c, n), see `Gaps.follow`.

    Signals are the states, and estimates of them for undisturbed time, after losses, and from inputs alone.
    """
    states, filtered, after_loss, from_inputs = signals
    half, fading = bank.half[:, :, None], np.ones(len(F))
    fading[measured] = 0.0
    x, squares = np.repeat(filtered[:1], half.shape[1], axis=0), np.zeros_like(filtered[:1])
    offset, age, count = x - from_inputs[0], np.zeros((2, *x.shape)), np.zeros(missing.shape[1])
    blend = age[1]
    for k, lost in enumerate(missing[:-1]):
        share = np.where(lost[:, None], 1.0, fading * blend)
        offset = offset + (~lost[:, None] * (x - from_inputs[k] - offset))[..., measured] @ bank.pull.T
        offset = (offset + (1 - share) * (x - from_inputs[k] - offset)) @ F.T
        count = np.where(lost, count + 1, 0.0)
        age = np.maximum(
            np.where(lost[:, None], age, bank.recovery[:, None, None, None] * np.minimum(age, OLDEST * half)),
            count[:, None],
        )
        after, blend = level(age, half)
        x = filtered[k + 1] + fading * after * (after_loss[k + 1] - filtered[k + 1])
        x += fading * blend * (from_inputs[k + 1] + offset - x)
        squares = squares + (x - states[k + 1]) ** 2
    return squares / len(missing)
