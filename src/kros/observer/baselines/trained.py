"""Gradient boosting and a neural network on past samples: what users of scikit-learn would try first."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from ...core import AnyArray, Array, DataError, MissingDependencyError, Parameters, frozen
from ...data import EpisodeBatch
from .difference import hold_missing

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
