r"""Subspace-identified predictors: low-order models for hidden states, identified from recordings in which these are known.

A correction filter sees innovations only, and a model of the recorded states does not hold a machine's other states: the integrator of its
controller, the load. Here the hidden states are regressed on the past of what the observer sees,

.. math:: z = [\,y - M u;\; u_f;\; \sigma(y)\,],

(u_f the inputs that no measurement follows) through a basis of delays of all and slow lags of the first
(as for `shaping_filter`), ``s+ = S s + E z``, ``x_h = W s``. Only few directions of s matter: with P the second moment of s *as recorded* and
Q the observability Gramian of (W, S), the leading eigenvectors of ``Q^(1/2) P Q^(1/2)`` span the states that are kept. In the
coordinates where Q is the identity S is a contraction, and so is any orthogonal projection of it: the reduced model is *always stable*.

The hidden states become coordinates of it, the other directions states ``memory_1, ...`` of the observer's model. The measured state enters as
``y = y_hat + nu``, equal columns of A and of the gain. So the result is an `Observer` like any other, which runs and is certified (`relift_certificate`)
as all are: extra states start at zero and nothing has to be recorded for them.

References
----------
D. F. Enns, "Model reduction with balanced realizations: an error bound and a frequency weighted generalization", CDC 1984, 127-132.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError, DimensionError
from ...core.linalg import least_squares
from ...core.norms import gramian
from ...data import EpisodeBatch
from ...lifting import Lifting
from ...synthesis.residual_shaped.shaping_filter import Basis

Array = npt.NDArray[np.float64]
DELAYS = 40
THIN, SKIP = 4, 300
SHORT = 25  # internal states forget within this part of an episode by default
_RIDGE, _FOLLOWS, _APART, _NEGLIGIBLE = 1e-5, 0.5, 0.1, 1e-13


@dataclass(frozen=True, eq=False)
class PastMoments:
    """What the units' recordings say about their hidden states: moments of the basis's states, common to any order.

    Parameters
    ----------
    lifting : Lifting
    measured : tuple of int
    basis : Basis
    static : ndarray, shape (q, m)
        M, the part of the measurement that the inputs explain.
    free : tuple of int
        Inputs that no measurement follows.
    units : tuple of str
    gram : ndarray, shape (unit, N, N)
        Second moments of s.
    cross : ndarray, shape (unit, N, h)
        Of s and the hidden states.
    power : ndarray, shape (unit, h)
        Mean squares of the hidden states.
    """

    lifting: Lifting
    measured: tuple[int, ...]
    basis: Basis
    static: Array
    free: tuple[int, ...]
    units: tuple[str, ...]
    gram: Array
    cross: Array
    power: Array

    @classmethod
    def of(
        cls,
        lifting: Lifting,
        measured: Sequence[int],
        batch: EpisodeBatch,
        basis: Basis | None = None,
    ) -> PastMoments:
        """Collect moments of recordings.

        Parameters
        ----------
        lifting : Lifting
            Its functions read measured states alone; no delays, no functions of inputs.
        measured : sequence of int
        batch : EpisodeBatch
        basis : Basis, optional
            By default 40 delays, and a lag of the tracking errors that forgets in a twenty-fifth of the shortest episode: controllers
            integrate.

        Raises
        ------
        DimensionError
            When the lifting reads hidden or earlier values, or has functions of inputs.
        DataError
            When every state is measured, or an episode is too short.
        """
        seen = {lifting.states[i] for i in measured} | set(lifting.parameters)
        if lifting.history or lifting.input_functions or any(set(f.used) - seen for f in lifting.formulas):
            raise DimensionError(
                f"Predictor: functions of the lifting should read {', '.join(sorted(seen))} alone, found {', '.join(lifting.functions)}."
            )
        hidden, lengths, states, inputs = hidden_of(lifting, measured), batch.lengths, batch.states, batch.inputs
        if not hidden or lengths.min() <= 2 * SKIP:
            raise DataError(
                f"Predictor: needs a state that is not measured and episodes of more than {2 * SKIP} samples, "
                f"found {len(hidden)} and {lengths.min()}."
            )
        basis = basis or Basis(DELAYS, (1 - SHORT / int(lengths.min()),))
        y = batch.measurements(measured, arrived=False)
        static = _static(inputs, y)
        share = np.abs(static) * _centred(inputs).std(axis=0) / np.maximum(_centred(y).std(axis=0), np.finfo(float).tiny)[:, None]
        free = tuple(int(j) for j in np.flatnonzero(share.max(axis=0) < _FOLLOWS))
        z = _channels(lifting, tuple(measured), static, free, batch)
        names = tuple(dict.fromkeys(batch.units))
        size = basis.delays * z.shape[-1] + len(basis.poles) * len(measured)
        gram, cross, power = (
            np.zeros((len(names), size, size)),
            np.zeros((len(names), size, len(hidden))),
            np.zeros((len(names), len(hidden))),
        )
        counts = np.zeros(len(names))
        for i, unit in enumerate(batch.units):
            rows, k = np.arange(SKIP, lengths[i], THIN), names.index(unit)
            s, truth = _basis_states(basis, z[:, i], rows, len(measured)), states[rows, i][:, hidden]
            gram[k] += s.T @ s
            cross[k] += s.T @ truth
            power[k] += np.sum(truth**2, axis=0)
            counts[k] += len(rows)
        each = counts[:, None]
        return cls(lifting, tuple(measured), basis, static, free, names, gram / each[:, None], cross / each[:, None], power / each)

    def model(
        self, order: int, without: Sequence[str] = (), importance: npt.ArrayLike = 1.0, deviation: float = 0.0
    ) -> tuple[Array, Array, Array]:
        """Return a stable model ``h+ = F h + G z``, ``x_h = H h`` of an order, of all units but some; F (order, order).

        `importance`, shape (h,) or a number, weights the hidden states' mean square errors, each relative to what the whole basis leaves of it.
        With `deviation` every lifted function's effect is known but for an independent factor 1 +- deviation, which differs from machine to machine.

        Raises
        ------
        DataError
            When no unit is left.
        DimensionError
            When the order is below the number of hidden states.
        """
        rows = [i for i, unit in enumerate(self.units) if unit not in without]
        if not rows:
            raise DataError(f"Predictor: no unit is left without {', '.join(sorted(without))}; record more units.")
        P, cross, power = self.gram[rows].mean(axis=0), self.cross[rows].mean(axis=0), self.power[rows].mean(axis=0)
        if not cross.shape[1] <= order:
            raise DimensionError(f"Predictor: {cross.shape[1]} hidden states need an order of at least as many, found {order}.")
        q, delays = len(self.measured), self.basis.delays
        channels = (len(P) - len(self.basis.poles) * q) // delays
        S, E = self.basis.system(channels)
        present = [i for i in range(len(S)) if i < delays * channels or i % channels < q]
        size = self._channel_sizes(P, channels)
        P, cross = P / np.outer(size, size), cross / size[:, None]
        S, E = S[np.ix_(present, present)] * size / size[:, None], E[present] / size[:, None]
        functions = len(self.lifting.functions)
        for channel in range(channels - functions, channels):
            own = np.arange(channel, delays * channels, channels)
            P[np.ix_(own, own)] *= 1 + deviation**2
        W = _ridge(P, cross, self.basis, channels)
        left = np.sqrt(np.maximum(power - 2 * np.sum(W * cross.T, axis=1) + np.sum((W @ P) * W, axis=1), _NEGLIGIBLE * power))
        values, vectors = np.linalg.eigh(gramian(S.T, (W * (np.sqrt(importance) / left)[:, None]).T, 1.0))
        kept = values > _NEGLIGIBLE * values[-1]
        root, inverse = np.sqrt(values[kept])[:, None] * vectors[:, kept].T, vectors[:, kept] / np.sqrt(values[kept])
        leading = np.linalg.eigh(root @ P @ root.T)[1][:, ::-1][:, :order]
        down, up = leading.T @ root, inverse @ leading
        scale = np.sqrt(np.diag(down @ P @ down.T))
        down, up = down / scale[:, None], up * scale
        return down @ S @ up, down @ E, W @ up

    def channels(self, batch: EpisodeBatch) -> Array:
        """Return the channels z along recordings, shape (n_samples, batch, channels)."""
        return _channels(self.lifting, self.measured, self.static, self.free, batch)

    def _channel_sizes(self, P: Array, channels: int) -> Array:
        """Size of the channel that every state of the basis is of: what is negligible must not depend on units of measure."""
        delays, q = self.basis.delays, len(self.measured)
        power = np.diag(P)[: delays * channels].reshape(delays, channels).mean(axis=0)
        size = np.sqrt(np.where(power > 0, power, 1.0))
        return np.concatenate([np.tile(size, delays), np.tile(size[:q], len(self.basis.poles))])


def hidden_of(lifting: Lifting, measured: Sequence[int]) -> list[int]:
    """Indices of the states that are not measured."""
    return [i for i in range(lifting.n_states) if i not in measured]


def _centred(values: Array) -> Array:
    rows = values.reshape(-1, values.shape[-1])
    return np.asarray(rows - rows.mean(axis=0))


def _static(inputs: Array, y: Array) -> Array:
    """M, shape (q, m): on the first samples, where machines rest, if they start in different places; else on all.

    A lag that depends on the speed would bias M by little, but start every run with an error that the differences of the past magnify.
    """
    starts = np.all(y[0].std(axis=0) > _APART * _centred(y).std(axis=0))
    rows, values = (inputs[:1], y[:1]) if starts else (inputs, y)
    return least_squares(_centred(rows), _centred(values), rcond=1e-9).T


def _channels(lifting: Lifting, measured: tuple[int, ...], static: Array, free: tuple[int, ...], batch: EpisodeBatch) -> Array:
    y, u, x = batch.measurements(measured, arrived=False), batch.inputs, np.zeros((*batch.states.shape[:-1], lifting.n_states))
    x[..., list(measured)] = y
    return np.concatenate([y - u @ static.T, u[..., list(free)], lifting.lift(x, batch.parameters)[..., lifting.n_states :]], axis=-1)


def _basis_states(basis: Basis, z: Array, rows: npt.NDArray[np.intp], slow: int) -> Array:
    """States s of one episode at some samples: delays of all channels, then lags of the first few, shape (rows, N)."""
    from scipy.signal import lfilter

    delayed = [z[np.maximum(rows - j, 0)] for j in range(1, basis.delays + 1)]
    lags = [lfilter([0.0, np.sqrt(1 - p**2)], [1.0, -p], z[:, :slow], axis=0)[rows] for p in basis.poles]
    return np.concatenate([*delayed, *lags], axis=1)


def _ridge(P: Array, cross: Array, basis: Basis, channels: int) -> Array:
    """Weights W of the hidden states, shape (h, N); the penalty is on differences of neighbouring samples, as the samples are nearly alike."""
    n = basis.delays * channels
    change = np.eye(len(P)) - np.diag((np.arange(len(P) - channels) < n - channels).astype(float), -channels)
    P, cross = change @ P @ change.T, change @ cross
    size = np.sqrt(np.maximum(np.diag(P), np.finfo(float).tiny))
    weights = np.linalg.solve(P / np.outer(size, size) + _RIDGE * np.eye(len(P)), cross / size[:, None]) / size[:, None]
    return np.asarray((change.T @ weights).T)
