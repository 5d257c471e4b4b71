r"""A learned estimator without a model: ridge regression on the last hundred samples, a yardstick.

With z = [y; u] and d delays, the estimate at sample k is

    x_hat_k = w_0 + sum_j W_j z_{k-1-j},   j = 0, ..., d - 1,

linear in the samples and a constant; what came before the first sample is taken to equal it. The regression is in the
coordinates [z_{k-1}; z_{k-1-j} - z_{k-j}], divided by their RMS: neighbouring samples of a slow signal are nearly
equal.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from ...core import TINY, Array, Columns, DataError, Names, Parameters, Whole, frozen
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
