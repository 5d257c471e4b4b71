r"""A learned estimator without a model: ridge regression of the hidden states on the recent past, as a yardstick without any guarantee.

What it sees at sample k - 1 and before, 40 samples by default, is

    z = [ y - c - M u ;  u ;  sigma(y) ;  d sigma / dy (y) ]

the measurement less what the inputs alone say of it (for a drive: the tracking error), the recorded inputs, and those lifted functions that read
measured states alone, with their slopes (for a drive: sine and cosine of the gearbox angle). The estimate is linear in these samples. Every
unit leaves its moments, so that an estimator trained *without* a unit costs one solution of the normal equations; c and M alone are
common to all.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError, DimensionError
from ...core.linalg import least_squares
from ...data import EpisodeBatch
from ...data.batch import hold_missing
from ...lifting import Lifting

Array = npt.NDArray[np.float64]
TAPS = 40
RIDGE = 1e-5  # from 1e-8 to 1e-4 errors differ by less than one percent


@dataclass(frozen=True, eq=False)
class Features:
    """The channels that the estimator looks at.

    Parameters
    ----------
    lifting : Lifting
    measured : tuple of int
    taps : int
        Samples of the past.
    static : ndarray, shape (q, 1 + m)
        Offset c and matrix M of the measurement that the inputs explain.
    """

    lifting: Lifting
    measured: tuple[int, ...]
    static: Array
    taps: int = TAPS

    @classmethod
    def of(cls, lifting: Lifting, measured: Sequence[int], y: Array, u: Array, taps: int = TAPS) -> Features:
        """Fit the static part on recordings y (n_samples, batch, q) and u (n_samples, batch, m)."""
        inputs = np.concatenate([np.ones((*u.shape[:-1], 1)), u], axis=-1).reshape(-1, 1 + u.shape[-1])
        static = least_squares(inputs, y.reshape(-1, y.shape[-1])).T
        return cls(lifting, tuple(measured), static, taps)

    @property
    def visible(self) -> tuple[int, ...]:
        """Lifted functions that read measured states and parameters alone."""
        seen = {self.lifting.states[i] for i in self.measured} | set(self.lifting.parameters)
        return tuple(i for i, formula in enumerate(self.lifting.formulas) if set(formula.used) <= seen)

    def channels(self, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
        """Return z, shape (n_samples, batch, channels), of y (n_samples, batch, q) and u (n_samples, batch, m); parameters of shape (batch,)."""
        if y.shape[:-1] != u.shape[:-1] or y.shape[-1] != len(self.measured) or u.shape[-1] + 1 != self.static.shape[1]:
            raise DimensionError(
                f"Learned estimator: expected {len(self.measured)} measurements and {self.static.shape[1] - 1} inputs, found {y.shape} and {u.shape}."
            )
        parts = [y - self.static[:, 0] - u @ self.static[:, 1:].T, u]
        if self.visible:
            bare = replace(self.lifting, functions=tuple(self.lifting.functions[i] for i in self.visible), input_functions=())
            x = np.zeros((*y.shape[:-1], bare.n_states))
            x[..., list(self.measured)] = y
            slopes = bare.slopes(x, parameters)[..., list(self.measured)]
            parts += [bare.lift(x, parameters)[..., bare.n_states :], slopes.reshape(*y.shape[:-1], -1)]
        return np.concatenate(parts, axis=-1)

    def past(self, z: Array, rows: npt.NDArray[np.intp]) -> Array:
        """Return the latest sample before each of `rows` and the differences of all before it, shape (rows, batch, channels * taps)."""
        lags = np.arange(1, self.taps + 1)
        windows = z[rows[:, None] - lags]  # (rows, taps, batch, channels)
        windows[:, 1:] -= windows[:, :-1].copy()
        return np.moveaxis(windows, 1, -1).reshape(len(rows), z.shape[1], -1)


@dataclass(frozen=True, eq=False)
class Moments:
    """What every unit leaves of its training episodes: means of products of regressors and estimated states.

    Parameters
    ----------
    features : Features
    estimated : tuple of int
        Indices of the estimated states.
    units : tuple of str
    gram : ndarray, shape (unit, 1 + f, 1 + f)
        Of the constant and the regressors.
    cross : ndarray, shape (unit, 1 + f, h)
    """

    features: Features
    estimated: tuple[int, ...]
    units: tuple[str, ...]
    gram: Array
    cross: Array

    @classmethod
    def of(
        cls,
        features: Features,
        batch: EpisodeBatch,
        thin: int = 4,
    ) -> Moments:
        """Collect the moments of training episodes; every `thin`-th sample counts.

        Raises
        ------
        DataError
            When every state is measured, or an episode is no longer than the past.
        """
        states, lengths, units = batch.states, batch.lengths, batch.units
        estimated = tuple(i for i in range(states.shape[-1]) if i not in features.measured)
        if not estimated:
            raise DataError("Learned estimator: every state is measured, there is nothing to estimate.")
        if lengths.min() <= features.taps:
            raise DataError(
                f"Learned estimator: an episode of unit {units[int(lengths.argmin())]} has {lengths.min()} samples, more than {features.taps} are needed."
            )
        z = features.channels(hold_missing(batch.measurements(features.measured)), batch.inputs, batch.parameters)
        names = tuple(dict.fromkeys(units))
        f, h = 1 + z.shape[-1] * features.taps, len(estimated)
        gram, cross, counts = np.zeros((len(names), f, f)), np.zeros((len(names), f, h)), np.zeros(len(names))
        for i, unit in enumerate(units):
            rows = np.arange(features.taps, lengths[i], thin)
            past = features.past(z[:, i : i + 1], rows)[:, 0]
            past = np.concatenate([np.ones((len(rows), 1)), past], axis=1)
            truth, k = states[rows, i][:, list(estimated)], names.index(unit)
            gram[k] += past.T @ past
            cross[k] += past.T @ truth
            counts[k] += len(rows)
        return cls(features, estimated, names, gram / counts[:, None, None], cross / counts[:, None, None])

    def estimator(self, without: Collection[str] = (), ridge: float = RIDGE) -> Learned:
        """Train on all units but some; names of units that took no part are ignored.

        `ridge` is a penalty relative to the regressors' mean squares; the constant is not penalised.

        Raises
        ------
        DataError
            When no unit is left.
        """
        rows = [i for i, unit in enumerate(self.units) if unit not in without]
        if not rows:
            raise DataError(f"Learned estimator: no unit is left to train on without {', '.join(sorted(without))}; record more units.")
        gram, cross = self.gram[rows].mean(axis=0), self.cross[rows].mean(axis=0)
        size = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
        penalty = np.diag([0.0] + [ridge] * (len(size) - 1))
        weights = np.linalg.solve(gram / np.outer(size, size) + penalty, cross / size[:, None]) / size[:, None]
        taps, h = self.features.taps, len(self.estimated)
        differences = weights[1:].reshape(-1, taps, h)
        response = differences.copy()
        response[:, :-1] -= differences[:, 1:]
        return Learned(self.features, self.estimated, weights[0], response)


@dataclass(frozen=True, eq=False)
class Learned:
    """The trained estimator.

    Parameters
    ----------
    features : Features
    estimated : tuple of int
        Indices of the estimated states.
    constant : ndarray, shape (h,)
    response : ndarray, shape (channels, taps, h)
        Weights of the samples at k - 1, k - 2, ...
    """

    features: Features
    estimated: tuple[int, ...]
    constant: Array
    response: Array

    def run(self, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
        """Estimate a batch from y (n_samples, batch, q) and u (n_samples, batch, m), shape (n_samples, batch, n); parameters of shape (batch,).

        Row k from data up to k - 1, what came before the first sample taken to equal it; NaN for states that are not estimated.
        """
        from scipy.fft import irfft, next_fast_len, rfft

        z = self.features.channels(y, u, parameters)
        z = np.concatenate([np.repeat(z[:1], self.features.taps, axis=0), z[:-1]])
        first, z = z[:1], z - z[:1]
        size = next_fast_len(len(z) + self.features.taps, real=True)
        spectrum = np.moveaxis(rfft(z, size, axis=0), -1, 1)
        estimate = np.full((*y.shape[:-1], self.features.lifting.n_states), np.nan)
        for column, state in enumerate(self.estimated):
            weights = self.response[..., column]
            moving = irfft(np.einsum("fcb,cf->fb", spectrum, rfft(weights, size, axis=1), optimize=True), size, axis=0)
            estimate[..., state] = self.constant[column] + first[0] @ weights.sum(axis=1) + moving[self.features.taps - 1 : len(z)]
        return estimate
