r"""Tuning of linear models for hidden states: all coefficients, dynamics included, by Gauss-Newton steps.

The estimates are ``x_h = H (q I - F)^-1 G z`` with z as recorded (`seen_by`): no observer has to be run for a step. The criterion is

.. math:: \sum_i s_i \log \bigl( \operatorname{mean}_u \overline{e_{iu}^2} \bigr)^{1/2},

with :math:`\overline{e_{iu}^2}` the mean square error of hidden state i on unit u. Every episode counts twice, with the lifted functions larger and smaller
by a share: machines on which they act more or less than on the mean machine look like that, and an observer that relied on what it was told of
them would fail where others adapt. Steps are taken in coordinates in which the states are white along the recordings, all coefficients free: of the many
models with the same estimates, the nearest one. In those of companion forms or of single modes the search ends early.

References
----------
T. McKelvey, A. Helmersson and T. Ribarits, "Data driven local coordinates for multivariable linear systems and their application to system
identification", Automatica 40 (2004) 1629-1635.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from ...core.errors import DataError
from .blocks import Array, Block, Model, blocks_of, joined
from .moments import Past, hidden_of, seen_by

_DAMPING = (1e-7, 1e-3, 1e4)
_THIN, _SIDE_BY_SIDE = 8, 4  # episodes: keeps derivatives in some ten megabytes
_ALIKE = 1e-13  # share of a direction below which rounding decides
_BOUND, _AT_BOUND = 1e4, 1 - 1e-6  # a pole at its bound stays there instead of ending the search
_MEMORIES = 3  # models forget within this part of an episode: what is slower, recordings of this length cannot judge


def tune_memory(
    model: Model,
    past: Past,
    states: Array,
    inputs: Array,
    units: Sequence[str],
    parameters: Mapping[str, npt.ArrayLike] | None = None,
    importance: npt.ArrayLike = 1.0,
    deviation: float = 0.0,
    slowest: float | None = None,
    iterations: int = 25,
    least_gain: float = 1e-4,
) -> tuple[Model, tuple[float, ...]]:
    """Improve a model of `Past.model` on recordings.

    Parameters
    ----------
    model : F (order, order), G (order, channels), H (h, order)
        A stable one.
    past : Past
        Says what the channels are.
    states : ndarray, shape (n_samples, batch, n)
    inputs : ndarray, shape (n_samples, batch, m)
    units : sequence of str, length batch
    parameters : mapping of str to array_like, shape (batch,)
    importance : array_like, shape (h,)
        Weights s of the logarithms.
    deviation : float
        Share by which the lifted functions' effect may differ from machine to machine.
    slowest : float, optional
        Bound of the model's poles; by default what recordings of this length can judge, or the model's own slowest pole.
    iterations : int
        Most steps.
    least_gain : float
        Decrease of the criterion in two steps below which the search ends.

    Returns
    -------
    model : F, G, H
    criterion : tuple of float
        Before tuning and after every step.

    Raises
    ------
    DataError
        When the model diverges on the recordings.
    """
    problem = _Tuning.of(past, states, inputs, units, parameters, importance, deviation)
    low, damping, high = _DAMPING
    blocks, own = blocks_of(*model), float(np.abs(np.linalg.eigvals(model[0])).max())
    slowest = max(own, 1 - _MEMORIES / len(states) if slowest is None else slowest)
    if not slowest < 1:
        raise DataError("Tuning an observer with memory: the model is not stable; start from one that is.")
    error = problem.errors(blocks)
    criterion = [problem.criterion(error)]
    for _ in range(iterations):
        H, g, outward, change = problem.normal_equations(blocks, error)
        bounded = np.outer(outward, outward) * _BOUND if _radius(blocks) > slowest * _AT_BOUND else np.zeros_like(H)
        while damping <= high:
            damped = H + damping * np.eye(len(g))
            step = np.linalg.solve(damped, g)
            if outward @ step > 0:
                step = np.linalg.solve(damped + bounded, g)
            trial = [b.within(slowest) for b in blocks_of(*_sum(joined(blocks), change(np.asarray(step, dtype=float))))]
            error_then = problem.errors(trial)
            if problem.criterion(error_then) < criterion[-1]:
                break
            damping *= 4
        else:
            break
        blocks, error, damping = trial, error_then, max(damping / 10, low)
        criterion.append(problem.criterion(error))
        if len(criterion) > 2 and criterion[-3] - criterion[-1] < least_gain:
            break
    return joined(blocks), tuple(criterion)


@dataclass(frozen=True, eq=False)
class _Tuning:
    """Recordings to tune on, samples on the last axis."""

    z: Array
    truth: Array
    rest: Array
    unit: npt.NDArray[np.intp]
    share: Array

    @classmethod
    def of(
        cls,
        past: Past,
        states: Array,
        inputs: Array,
        units: Sequence[str],
        parameters: Mapping[str, npt.ArrayLike] | None,
        importance: npt.ArrayLike,
        deviation: float,
    ) -> _Tuning:
        """Collect the channels, twice where machines deviate."""
        hidden = hidden_of(past.lifting, past.measured)
        seen = seen_by(past.lifting, past.measured, past.static, past.free, states[..., list(past.measured)], inputs, parameters)
        z, truth = (np.ascontiguousarray(np.moveaxis(a, 0, 2).swapaxes(0, 1)) for a in (seen, states[..., hidden]))
        names = list(dict.fromkeys(units))
        unit = np.array([names.index(u) for u in units])
        lifted = slice(len(z) - len(past.lifting.functions), None)
        if deviation and past.lifting.functions:
            sign = np.where(np.arange(len(unit)) % 2 == 0, deviation, -deviation)[:, None]
            both = [z.copy(), z.copy()]
            both[0][lifted] *= 1 + sign
            both[1][lifted] *= 1 - sign
            z, truth, unit = np.concatenate(both, axis=1), np.concatenate([truth, truth], axis=1), np.tile(unit, 2)
        rest = np.zeros(z.shape[:2])
        rest[lifted] = z[lifted, :, 0]
        share = np.broadcast_to(np.asarray(importance, dtype=float), len(hidden))
        return cls(z, truth, rest, unit, share / share.sum())

    def errors(self, blocks: Sequence[Block]) -> Array:
        """Mean square errors, shape (unit, h)."""
        found, counts = np.zeros((self.unit.max() + 1, len(self.truth))), np.bincount(self.unit)
        with np.errstate(over="ignore", invalid="ignore"):
            for part in self._parts():
                missed = self._missed(blocks, part)[2]
                np.add.at(found, self.unit[part], np.mean(missed**2, axis=-1).T)
        return found / counts[:, None]

    def criterion(self, error: Array) -> float:
        """The criterion of mean square errors by unit; infinite where the model diverges."""
        if not np.isfinite(error).all():
            return np.inf
        return float(self.share @ np.log(error.mean(axis=0)) / 2)

    def normal_equations(self, blocks: Sequence[Block], error: Array) -> tuple[Array, Array, Array, Callable[[Array], Model]]:
        """Gauss-Newton matrix and right side for scaled coefficients, the direction that slows the slowest pole, and what takes a step to F, G, H.

        Coefficients are those of all states and channels, white along the recordings, in the rows of white states: directions that change no
        estimate, and those between nearly alike channels, cost nothing.
        """
        n, outputs = sum(len(b.F) for b in blocks), len(self.truth)
        into, out = self._whitening(blocks)
        width = into.shape[1]
        weight = self.share / error.sum(axis=0) / np.bincount(self.unit)[:, None]
        H, g = np.zeros((n * (width + outputs),) * 2), np.zeros(n * (width + outputs))
        for part in self._parts():
            h, rest, missed = self._missed(blocks, part)
            signals = np.tensordot(into.T, np.concatenate([h, self.z[:, part]]), 1)
            rest = np.tensordot(into.T, np.concatenate([rest, self.rest[:, part]]), 1)
            inner = np.concatenate([b.responses(signals, rest, _THIN) for b in blocks])
            direct = np.zeros((outputs, *h[..., ::_THIN].shape[:1], outputs, *h[..., ::_THIN].shape[1:]))
            direct[range(outputs), :, range(outputs)] = h[..., ::_THIN]
            root = np.sqrt(weight[self.unit[part]].T)[..., None]
            X = np.concatenate([(part_of * root).reshape(-1, root[..., 0].size * inner.shape[-1]) for part_of in (inner, direct)])
            H += X @ X.T
            g += X @ (missed[..., ::_THIN] * root).ravel()
        turn = block_diag(np.kron(np.linalg.pinv(out).T, np.eye(width)), np.kron(np.eye(outputs), out))
        H, g = turn.T @ H @ turn, turn.T @ g
        size = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))

        def change(step: Array) -> Model:
            inner, direct = np.split(turn @ (step / size), [n * width])
            moved = inner.reshape(n, width) @ into.T
            return moved[:, :n], moved[:, n:], direct.reshape(outputs, n)

        slows = np.hstack([_slowing(joined(blocks)[0]), np.zeros((n, len(self.z)))]) @ into
        outward = turn.T @ np.concatenate([slows.ravel(), np.zeros(outputs * n)]) / size
        return H / np.outer(size, size), g / size, outward / np.linalg.norm(outward), change

    def _whitening(self, blocks: Sequence[Block]) -> tuple[Array, Array]:
        """What makes all states and channels white along the recordings, and what makes the states so."""
        n = sum(len(b.F) for b in blocks)
        moments = np.zeros((n + len(self.z),) * 2)
        for part in self._parts():
            flat = np.concatenate([self._missed(blocks, part)[0][..., ::_THIN], self.z[:, part, ::_THIN]]).reshape(len(moments), -1)
            moments += flat @ flat.T
        moments *= _THIN / self.z[0].size
        return _white(moments), _white(moments[:n, :n])

    def _missed(self, blocks: Sequence[Block], part: slice) -> tuple[Array, Array, Array]:
        """States of all blocks on some episodes, their rest, and what the estimates miss."""
        runs = [b.run(self.z[:, part], self.rest[:, part]) for b in blocks]
        h, rest = np.concatenate([r[0] for r in runs]), np.concatenate([r[1] for r in runs])
        return h, rest, self.truth[:, part] - np.tensordot(np.hstack([b.H for b in blocks]), h, 1)

    def _parts(self) -> list[slice]:
        return [slice(i, i + _SIDE_BY_SIDE) for i in range(0, len(self.unit), _SIDE_BY_SIDE)]


def _sum(model: Model, change: Model) -> Model:
    return model[0] + change[0], model[1] + change[1], model[2] + change[2]


def _radius(blocks: Sequence[Block]) -> float:
    return max(float(np.abs(np.linalg.eigvals(b.F)).max()) for b in blocks)


def _slowing(F: Array) -> Array:
    """Derivative of the spectral radius by F, shape (n, n)."""
    values, vectors = np.linalg.eig(F)
    k = int(np.abs(values).argmax())
    turn = np.conj(values[k]) / np.abs(values[k])
    return np.asarray((turn * np.outer(np.linalg.inv(vectors)[k], vectors[:, k])).real)


def _white(moments: Array) -> Array:
    """T with ``T' moments T`` the identity, of full column rank where moments lack some."""
    size = np.sqrt(np.maximum(np.diag(moments), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(moments / np.outer(size, size))
    kept = values > _ALIKE * values[-1]
    return np.asarray(vectors[:, kept] / np.sqrt(values[kept]) / size[:, None])
