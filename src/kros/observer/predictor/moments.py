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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from ...core.errors import DataError, DimensionError
from ...core.linalg import least_squares
from ...core.norms import gramian
from ...data import EpisodeBatch
from ...lifting import Lifting
from ...loops import filtered
from ...synthesis.residual_shaped.shaping_filter import Basis
from .free_start import in_motion

Array = npt.NDArray[np.float64]
Model = tuple[Array, Array, Array]
Weights = Mapping[str, npt.ArrayLike]
DELAYS = 40
THIN, SKIP = 4, 300
SHORT = 25  # internal states forget within this part of an episode by default
_RIDGE, _FOLLOWS, _APART, _NEGLIGIBLE = 1e-5, 0.5, 0.01, 1e-13
_REWEIGHTED = 3
_CHANGES, _EXPLAINS = (2, 10, 50), 1.05  # samples; growth of the error


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
        Unit of every row: a row is what one unit did in one condition.
    gram : ndarray, shape (row, N, N)
        Second moments of s.
    cross : ndarray, shape (row, N, h)
        Of s and the hidden states.
    power : ndarray, shape (row, h)
        Mean squares of the hidden states.
    conditions : tuple of str
        Condition of every row; one and the same where none is given.

    Examples
    --------
    >>> import kros
    >>> from kros.data import EpisodeBatch
    >>> from kros.lifting import Lifting
    >>> from kros.observer import PastMoments
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=1, seconds=2.0, seed=3).simulate().population
    >>> moments = PastMoments.of(Lifting(motors.states), (0,), EpisodeBatch.read(motors, motors.keys()))
    >>> moments.units, moments.power.shape
    (('001', '002'), (2, 2))
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
    conditions: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        lifting: Lifting,
        measured: Sequence[int],
        batch: EpisodeBatch,
        basis: Basis | None = None,
        until: npt.ArrayLike | None = None,
        without: npt.NDArray[np.bool_] | None = None,
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
        until : array_like of int, shape (batch,), optional
            Samples of every episode before its machine comes to a limit; those behind are rows of their own, of the condition `limited`.
        without : ndarray of bool, shape (n_samples, batch), optional
            Samples that do not count.

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
        basis = basis or Basis(DELAYS, (1 - SHORT / int(lengths.min()),))
        if not hidden or lengths.min() <= 2 * basis.delays:
            raise DataError(
                f"Predictor: needs a state that is not measured and episodes of more than {2 * basis.delays} samples, "
                f"found {len(hidden)} and {lengths.min()}."
            )
        y = batch.measurements(measured, arrived=False)
        static, free = followed_inputs(inputs, y, states[..., hidden])
        z = _channels(lifting, tuple(measured), static, free, batch)
        ends = lengths if until is None else np.minimum(np.asarray(until), lengths)
        own = [(key.unit, key.condition) for key in batch.keys]
        pieces = [(i, own[i], skipped(int(lengths[i])), int(ends[i])) for i in range(len(own))]
        pieces += [(i, (own[i][0], limited(own[i][1])), int(ends[i]), int(lengths[i])) for i in range(len(own))]
        pieces = [piece for piece in pieces if piece[3] - piece[2] >= THIN]
        names = tuple(dict.fromkeys(name for _, name, _, _ in pieces))
        size = basis.delays * z.shape[-1] + len(basis.poles) * len(measured)
        gram, cross, power = (
            np.zeros((len(names), size, size)),
            np.zeros((len(names), size, len(hidden))),
            np.zeros((len(names), len(hidden))),
        )
        counts = np.zeros(len(names))
        for i, name, start, end in pieces:
            rows, k = np.arange(start, end, THIN), names.index(name)
            rows = rows if without is None else rows[~without[rows, i]]
            s, truth = _basis_states(basis, z[:, i], rows, len(measured)), states[rows, i][:, hidden]
            gram[k] += s.T @ s
            cross[k] += s.T @ truth
            power[k] += np.sum(truth**2, axis=0)
            counts[k] += len(rows)
        each, (units, conditions) = np.maximum(counts, 1)[:, None], zip(*names, strict=True)
        moments = gram / each[:, None], cross / each[:, None], power / each
        return cls(lifting, tuple(measured), basis, static, free, tuple(units), *moments, tuple(conditions))

    def restricted(self, basis: Basis) -> PastMoments:
        """Return the same for fewer delays and lags of those that there are."""
        whole, channels, q = self.basis, self.n_channels, len(self.measured)
        lags = [whole.delays * channels + whole.poles.index(pole) * q + i for pole in basis.poles for i in range(q)]
        kept = np.array([*range(basis.delays * channels), *lags])
        return replace(self, basis=basis, gram=self.gram[:, kept[:, None], kept], cross=self.cross[:, kept])

    def model(
        self,
        order: int,
        without: Sequence[str] = (),
        importance: npt.ArrayLike = 1.0,
        deviation: float = 0.0,
        weights: Weights | None = None,
    ) -> Model:
        """Return a stable model ``h+ = F h + G z``, ``x_h = H h`` of an order, of all units but some; F (order, order).

        `importance`, shape (h,) or a number, weights the hidden states' mean square errors, each relative to what the whole basis leaves of it.
        With `deviation` every lifted function's effect is known but for an independent factor 1 +- deviation, which differs from machine to machine.
        `weights`: see `regression`.

        Raises
        ------
        DataError
            When no unit is left.
        DimensionError
            When the order is below the number of hidden states.
        """
        return self.balanced(without, importance, deviation, weights).model(order)

    def balanced(
        self,
        without: Sequence[str] = (),
        importance: npt.ArrayLike = 1.0,
        deviation: float = 0.0,
        weights: Weights | None = None,
    ) -> Balanced:
        """Return what all orders of `model` have in common."""
        W, P, left = self.regression(without, deviation, weights)
        q, delays, channels = len(self.measured), self.basis.delays, self.n_channels
        S, E = self.basis.system(channels)
        present = [i for i in range(len(S)) if i < delays * channels or i % channels < q]
        size = self._channel_sizes(P)
        P, W = P / np.outer(size, size), W * size
        S, E = S[np.ix_(present, present)] * size / size[:, None], E[present] / size[:, None]
        values, vectors = np.linalg.eigh(gramian(S.T, (W * (np.sqrt(importance) / left)[:, None]).T, 1.0))
        kept = values > _NEGLIGIBLE * values[-1]
        root, inverse = np.sqrt(values[kept])[:, None] * vectors[:, kept].T, vectors[:, kept] / np.sqrt(values[kept])
        leading = np.linalg.eigh(root @ P @ root.T)[1][:, ::-1]
        return Balanced(S, E, W, P, leading.T @ root, inverse @ leading)

    def regression(
        self, without: Sequence[str] = (), deviation: float = 0.0, weights: Weights | None = None
    ) -> tuple[Array, Array, Array]:
        """Regress the hidden states on the basis.

        Parameters
        ----------
        without : sequence of str
            Units that take no part.
        deviation : float
        weights : mapping of str to array_like, shape (h,) or a number, optional
            How much the error in every condition counts: the sum over units of logarithms of mean square errors, weighted by these, is made small, so
            that units on which more is left count relative to that. Those on which less is left than on the median unit of the condition count as
            this one: a short row cannot buy its own error with all others'. Without weights all rows count alike.

        Returns
        -------
        W : ndarray, shape (h, N)
        P : ndarray, shape (N, N)
            Second moments of s, lifted functions larger by their deviation.
        left : ndarray, shape (h,)
            Size of what is left.
        """
        rows = [i for i, unit in enumerate(self.units) if unit not in without]
        if not rows:
            raise DataError(f"Predictor: no unit is left without {', '.join(sorted(without))}; record more units.")
        power, share = self.power[rows], np.ones((len(rows), self.power.shape[1]))
        if weights is not None:
            own = [self.conditions[i] for i in rows]
            share = np.array(
                [np.broadcast_to(np.asarray(weights.get(c, 0.0)), power.shape[1:]) / own.count(c) for c in own]
            )
        share = share / share.sum(axis=0)
        found = self._solved(rows, share, deviation)
        for _ in range(_REWEIGHTED if weights is not None else 0):
            missed = self.errors(found[0])[rows]
            median = {c: np.median(missed[[i for i, other in enumerate(own) if other == c]], axis=0) for c in set(own)}
            relative = share / np.maximum(missed, [median[c] for c in own])
            found = self._solved(rows, relative / relative.sum(axis=0), deviation)
        return found

    def errors(self, W: Array) -> Array:
        """Return the mean square errors of a regression, shape (row, h)."""
        found = self.power - 2 * np.einsum("hn,rnh->rh", W, self.cross) + np.sum((W @ self.gram) * W, axis=-1)
        return np.maximum(found, _NEGLIGIBLE * self.power)

    def _solved(self, rows: list[int], share: Array, deviation: float) -> tuple[Array, Array, Array]:
        """Solve the normal equations of rows that count by shares, shape (row, h) of sum one for every hidden state."""
        channels, power = self.n_channels, np.sum(share * self.power[rows], axis=0)

        every = np.zeros(
            (share.shape[1] + 1, len(self.gram))
        )  # rows that take no part count nothing: no copy of the others
        every[0, rows], every[1:, rows] = share.mean(axis=1), share.T
        alike = bool(np.allclose(every[1:], every[0]))
        pooled = np.tensordot(every[:1] if alike else every, self.gram, 1)
        for P in pooled:
            for channel in range(channels - len(self.lifting.functions), channels):
                of_one = np.arange(channel, self.basis.delays * channels, channels)
                P[np.ix_(of_one, of_one)] *= 1 + deviation**2
        P = pooled[0]
        W, left, size = np.empty((share.shape[1], len(P))), np.empty(share.shape[1]), self._channel_sizes(P)
        for column, own in enumerate(share.T):
            cross, mine = np.tensordot(own, self.cross[rows][..., column], 1), pooled[0 if alike else column + 1]
            W[column] = _ridge(mine / np.outer(size, size), (cross / size)[:, None], self.basis, channels)[0] / size
            missed = power[column] - 2 * W[column] @ cross + W[column] @ mine @ W[column]
            left[column] = np.sqrt(max(missed, _NEGLIGIBLE * power[column]))
        return W, P, left

    @property
    def n_channels(self) -> int:
        """Number of channels z."""
        return (self.gram.shape[1] - len(self.basis.poles) * len(self.measured)) // self.basis.delays

    def channels(self, batch: EpisodeBatch) -> Array:
        """Return the channels z along recordings, shape (n_samples, batch, channels)."""
        return _channels(self.lifting, self.measured, self.static, self.free, batch)

    def states_at(self, z: Array, rows: npt.NDArray[np.intp]) -> Array:
        """Return the basis's states of one episode's channels, shape (n_samples, channels), at some samples: (rows, N)."""
        return _basis_states(self.basis, z, rows, len(self.measured))

    def _channel_sizes(self, P: Array) -> Array:
        """Size of the channel that every state of the basis is of: what is negligible must not depend on units of measure."""
        delays, q, channels = self.basis.delays, len(self.measured), self.n_channels
        power = np.diag(P)[: delays * channels].reshape(delays, channels).mean(axis=0)
        size = np.sqrt(np.where(power > 0, power, 1.0))
        return np.concatenate([np.tile(size, delays), np.tile(size[:q], len(self.basis.poles))])


@dataclass(frozen=True, eq=False)
class Balanced:
    """A regression in coordinates that are ordered by how much they matter: S, E, W of the basis, P its second moments, `down` and `up` to and fro."""

    S: Array
    E: Array
    W: Array
    P: Array
    down: Array
    up: Array

    def model(self, order: int) -> Model:
        """Return the model F, G, H of an order."""
        if not len(self.W) <= order:
            raise DimensionError(
                f"Predictor: {len(self.W)} hidden states need an order of at least as many, found {order}."
            )
        down, up = self.down[:order], self.up[:, :order]
        scale = np.sqrt(np.diag(down @ self.P @ down.T))
        down, up = down / scale[:, None], up * scale
        return down @ self.S @ up, down @ self.E, self.W @ up


def limited(condition: str) -> str:
    """Return what the rows of a condition are called in which a machine has come to a limit."""
    return f"{condition} at a limit"


def hidden_of(lifting: Lifting, measured: Sequence[int]) -> list[int]:
    """Indices of the states that are not measured."""
    return [i for i in range(lifting.n_states) if i not in measured]


def skipped(length: int) -> int:
    """Return how many samples at the start of an episode do not count: what was before is not known yet."""
    return min(SKIP, length // 4)


def followed_inputs(inputs: Array, y: Array, truth: Array) -> tuple[Array, tuple[int, ...]]:
    """Return the part M of the measurement that the inputs explain, shape (q, m), and the inputs that no measurement follows."""
    static = _static(inputs, y, in_motion(truth))
    left = _centred(y - inputs @ static.T).std(axis=0)
    static = np.where((left < _FOLLOWS * _centred(y).std(axis=0))[:, None], static, 0.0)
    share = (
        np.abs(static)
        * _centred(inputs).std(axis=0)
        / np.maximum(_centred(y).std(axis=0), np.finfo(float).tiny)[:, None]
    )
    return static, tuple(int(j) for j in np.flatnonzero(share.max(axis=0) < _FOLLOWS))


def _centred(values: Array) -> Array:
    rows = values.reshape(-1, values.shape[-1])
    return np.asarray(rows - rows.mean(axis=0))


def _static(inputs: Array, y: Array, moving: bool) -> Array:
    """M, shape (q, m): on the first samples, where machines rest there, if they start in different places; else beside what changes of the inputs explain.

    A lag that depends on the speed would bias M by little, but start every run with an error that the differences of the past magnify. An input that
    explains nothing beside its changes is left out.
    """
    if not moving and np.all(y[0].std(axis=0) > _APART * _centred(y).std(axis=0)):
        return least_squares(_centred(inputs[:1]), _centred(y[:1]), rcond=1e-9).T
    m, longest = inputs.shape[-1], max(_CHANGES)
    changes = [inputs[longest::THIN] - inputs[longest - d : len(inputs) - d : THIN] for d in _CHANGES]
    X, Y = _centred(np.concatenate([inputs[longest::THIN], *changes], axis=-1)), _centred(y[longest::THIN])
    size = X.std(axis=0)
    X = X / np.where(size > 0, size, 1.0)

    def fitted(kept: list[int]) -> tuple[Array, Array]:
        found = np.zeros((X.shape[1], Y.shape[1]))
        found[kept] = least_squares(X[:, kept], Y, rcond=1e-10)
        return found, np.mean((Y - X @ found) ** 2, axis=0)

    kept = [i for i in range(X.shape[1]) if size[i] > 0]
    best, left = fitted(kept)
    for j in range(m):
        fewer = [i for i in kept if i != j]
        if fewer and np.all((other := fitted(fewer))[1] <= _EXPLAINS * left):
            kept, (best, left) = fewer, other
    return (best[:m] / np.where(size > 0, size, 1.0)[:m, None]).T


def _channels(
    lifting: Lifting, measured: tuple[int, ...], static: Array, free: tuple[int, ...], batch: EpisodeBatch
) -> Array:
    y, u, x = (
        batch.measurements(measured, arrived=False),
        batch.inputs,
        np.zeros((*batch.states.shape[:-1], lifting.n_states)),
    )
    x[..., list(measured)] = y
    return np.concatenate(
        [y - u @ static.T, u[..., list(free)], lifting.lift(x, batch.parameters)[..., lifting.n_states :]], axis=-1
    )


def _basis_states(basis: Basis, z: Array, rows: npt.NDArray[np.intp], slow: int) -> Array:
    """States s of one episode at some samples: delays of all channels, then lags of the first few, shape (rows, N)."""
    count, channels = basis.delays, z.shape[1]
    found = np.empty((len(rows), count * channels + len(basis.poles) * slow))
    # What came before is taken to have been constant.
    windows = sliding_window_view(np.concatenate([np.repeat(z[:1], count, axis=0), z]), (count, channels))[:, 0]
    found[:, : count * channels] = windows[rows, ::-1].reshape(len(rows), count * channels)
    first, none = z[:1, :slow], np.zeros(slow)
    moved = (z[:, :slow] - first).T
    for i, p in enumerate(basis.poles):
        at = count * channels + i * slow
        held = filtered(np.sqrt(1 - p**2) * moved, none, -p, 0.0)[0]
        found[:, at : at + slow] = held.T[rows] + np.sqrt(1 - p**2) / (1 - p) * first
    return found


def _ridge(P: Array, cross: Array, basis: Basis, channels: int) -> Array:
    """Weights W of the hidden states, shape (h, N); the penalty is on differences of neighbouring samples, as the samples are nearly alike."""
    n = basis.delays * channels
    change = np.eye(len(P)) - np.diag((np.arange(len(P) - channels) < n - channels).astype(float), -channels)
    P, cross = change @ P @ change.T, change @ cross
    size = np.sqrt(np.maximum(np.diag(P), np.finfo(float).tiny))
    weights = np.linalg.solve(P / np.outer(size, size) + _RIDGE * np.eye(len(P)), cross / size[:, None]) / size[:, None]
    return np.asarray((change.T @ weights).T)
