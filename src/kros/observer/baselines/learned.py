r"""Learned estimators without a model: regressions on past samples, yardsticks.

Gradient boosting and a neural network are what users of scikit-learn would try first. `Learned` is a ridge regression.

With z = [y; u] and d delays, the estimate at sample k is

    x_hat_k = w_0 + sum_j W_j z_{k-1-j},   j = 0, ..., d - 1,

linear in the samples and a constant; what came before the first sample is taken to equal it. The regression is in the
coordinates [z_{k-1}; z_{k-1-j} - z_{k-j}], divided by their RMS: neighbouring samples of a slow signal are nearly
equal.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from ...core import (
    TINY,
    AnyArray,
    Array,
    Columns,
    DataError,
    MissingDependencyError,
    Names,
    Parameters,
    Whole,
    frozen,
)
from ...data import EpisodeBatch
from .difference import hold_missing


@frozen
class Ridge:
    """Settings of the regression."""

    delays: int = 100
    penalty: float = 1e-8  # on coefficients of regressors of RMS one, relative to the mean square of the residual
    rows: int = 100_000  # of all episodes together, evenly spread; neighbouring samples hardly differ


DEFAULT = Ridge()


@frozen
class Learned:
    """The trained estimator."""

    measured: Columns
    estimated: Columns
    constant: Array  # (h,)
    weights: Array  # (delays, q + m, h): the latest sample first

    def run(self, y: Array, u: Array, parameters: Parameters | None = None) -> Array:
        """Estimate a batch from y (n_samples, batch, q) and u (n_samples, batch, m), shape (n_samples, batch, n)."""
        from scipy.signal import oaconvolve

        del parameters
        z = np.concatenate([hold_missing(y), u], axis=-1)
        first, moved = z[0], np.concatenate([np.zeros((1, *z.shape[1:])), z[:-1] - z[0]])
        parts = oaconvolve(moved[..., None], self.weights[:, None], axes=0)[: len(y)]
        estimate = np.full((*y.shape[:-1], len(self.measured) + len(self.estimated)), np.nan)
        estimate[..., list(self.estimated)] = parts.sum(axis=2) + self.constant + first @ self.weights.sum(axis=0)
        return estimate


@frozen
class Moments:
    """Products of regressors and hidden states, summed over the episodes of every unit: a unit can be left out."""

    settings: Ridge
    measured: Columns
    estimated: Columns
    units: Names
    products: Array  # (unit, 1 + f + h, 1 + f + h)

    @classmethod
    def of(
        cls, batches: Iterable[EpisodeBatch], measured: Sequence[int], step: int = 1, settings: Ridge = DEFAULT
    ) -> Moments:
        """Collect every so many rows of training episodes."""
        total = dict[str, Array]()
        estimated: Columns = ()
        for batch in batches:
            estimated = tuple(i for i in range(batch.states.shape[-1]) if i not in measured)
            y = hold_missing(batch.measurements(measured))
            for i, (unit, length) in enumerate(zip(batch.units, batch.lengths.tolist(), strict=True)):
                z = np.concatenate([y[:length, i], batch.inputs[:length, i]], axis=-1)
                at = np.arange(0, length, step)
                rows = np.hstack([regressors(z, at, settings.delays), batch.states[at, i][:, list(estimated)]])
                total[unit] = total.get(unit, 0.0) + rows.T @ rows
        if not estimated:
            raise DataError("Learned estimator: every state is measured, there is nothing to estimate.")
        return cls(settings, tuple(measured), estimated, tuple(total), np.stack(list(total.values())))

    def estimator(self, without: Collection[str] = ()) -> Learned:
        """Train on all units but some; names of units that took no part are ignored."""
        rows = [i for i, unit in enumerate(self.units) if unit not in without]
        if not rows:
            raise DataError(
                f"Learned estimator: no unit is left without {', '.join(sorted(without))}; record more units."
            )
        h, delays = len(self.estimated), self.settings.delays
        products = self.products[rows].sum(axis=0)
        size = np.sqrt(np.maximum(np.diag(products), TINY))
        scaled = products / np.outer(size, size)
        penalty = self.settings.penalty * np.diag([0.0, *[1.0] * (len(size) - h - 1)])
        weights = np.linalg.solve(scaled[:-h, :-h] + penalty, scaled[:-h, -h:]) * size[-h:] / size[:-h, None]
        by_delay = weights[1:].reshape(delays, -1, h).copy()
        by_delay[:-1] -= weights[1:].reshape(delays, -1, h)[1:]
        return Learned(self.measured, self.estimated, weights[0], by_delay)


def regressors(z: Array, at: Whole, delays: int) -> Array:
    """Return [1, z_{k-1}, z_{k-2} - z_{k-1}, ...] for samples k, shape (len(at), 1 + d channels)."""
    padded = np.concatenate([np.repeat(z[:1], delays, axis=0), z[:-1]])
    past = padded[at[:, None] + np.arange(delays - 1, -1, -1)]
    past[:, 1:] -= past[:, :-1].copy()
    return np.hstack([np.ones((len(at), 1)), past.reshape(len(at), -1)])


Regressor = Literal["boosting", "network"]


@frozen
class Features:
    """What a regression sees at a sample: the sample before, the start, the time since, and what came between."""

    length: float  # samples of a typical episode
    delays: tuple[int, ...] = (1, 2, 3, 5, 8, 12, 20, 30, 50, 70, 100)  # samples
    averages: tuple[float, ...] = (0.003, 0.01, 0.03, 0.1, 0.3)  # time constants, shares of the typical episode

    def of(self, y: Array, u: Array) -> Array:
        """Return the features of an episode, (n_samples, q) and (n_samples, m), shape (n_samples, .)."""
        from scipy.signal import lfilter

        v = np.concatenate([hold_missing(y), u], axis=1)
        v, at = np.concatenate([v[:1], v[:-1]]), np.arange(len(v))
        parts = [v, np.broadcast_to(v[0], v.shape), np.minimum(at / self.length, 1.0)[:, None]]
        parts += [v - v[np.maximum(at - delay, 0)] for delay in self.delays]
        for share in self.averages:
            a = np.exp(-1 / (share * self.length))
            parts.append(lfilter([1 - a], [1, -a], v, axis=0, zi=a * v[:1])[0])
        return np.hstack(parts)


@frozen
class Trained:
    """A regression of scikit-learn for every hidden state."""

    n_states: int
    features: Features
    regressors: Mapping[int, Any]  # by state

    def run(self, y: Array, u: Array, parameters: Parameters | None = None) -> Array:
        """Estimate a batch from y (n_samples, batch, q) and u (n_samples, batch, m), shape (n_samples, batch, n)."""
        estimate = np.full((*y.shape[:-1], self.n_states), np.nan)
        for i in range(y.shape[1]):
            X = self.features.of(y[:, i], u[:, i])
            for state, regressor in self.regressors.items():
                estimate[:, i, state] = regressor.predict(X)
        return estimate


@frozen
class Rows:
    """Thinned rows of training episodes, with the unit of each."""

    measured: Sequence[int]
    features: Features
    X: Array  # (rows, .)
    states: Array  # (rows, n)
    units: AnyArray  # (rows,)

    @classmethod
    def of(
        cls, batches: Iterable[EpisodeBatch], measured: Sequence[int], lengths: Sequence[int], rows: int = 60_000
    ) -> Rows:
        """Collect about so many rows of episodes of these lengths, evenly spread."""
        step, features = max(1, sum(lengths) // rows), Features(float(np.median(lengths)))
        X, states, units = list[Array](), list[Array](), list[str]()
        for number, batch in enumerate(batches):
            some = slice(number % step, int(batch.lengths[0]), step)
            X.append(features.of(batch.measurements(measured)[:, 0], batch.inputs[:, 0])[some])
            states.append(batch.states[some, 0])
            units += [batch.units[0]] * len(X[-1])
        return cls(measured, features, np.vstack(X), np.vstack(states), np.array(units))

    def fitted(self, kind: Regressor, without: Sequence[str] = ()) -> Trained:
        """Train on all units but some."""
        rows, (_, n) = ~np.isin(self.units, without), self.states.shape
        if not rows.any():
            raise DataError(f"Regression: no unit is left without {', '.join(without)}; record more units.")
        X, Y = self.X[rows], self.states[rows]
        hidden = {i: regressor_of(kind).fit(X, Y[:, i]) for i in range(n) if i not in self.measured}
        return Trained(n, self.features, hidden)


def regressor_of(kind: Regressor) -> Any:
    """Return the regression of a kind, with scaling where it needs one."""
    try:
        from sklearn import compose, ensemble, neural_network, pipeline, preprocessing
    except ImportError as error:
        raise MissingDependencyError(
            f"Regression: the baseline {kind} needs scikit-learn, which is not installed; pip install 'kros[sklearn]'."
        ) from error
    if kind == "boosting":
        return ensemble.HistGradientBoostingRegressor(max_iter=500, early_stopping=True, random_state=0)
    layers = neural_network.MLPRegressor(hidden_layer_sizes=(64, 64), early_stopping=True, max_iter=300, random_state=0)
    scaled = pipeline.make_pipeline(preprocessing.StandardScaler(), layers)
    return compose.TransformedTargetRegressor(scaled, transformer=preprocessing.StandardScaler())
