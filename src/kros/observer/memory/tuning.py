r"""Tuning of linear models for hidden states: all coefficients, dynamics included, by Gauss-Newton steps.

The estimates are ``x_h = H (q I - F)^-1 G z`` with z as recorded (`seen_by`): no observer has to be run for a step. The criterion is

.. math:: \sum_i s_i \log \Bigl( \sum_u \overline{e_{iu}^2}^{\,p/2} \Bigr)^{1/p},

with :math:`\overline{e_{iu}^2}` the mean square error of hidden state i on unit u: p = 2 is the mean over units, and the larger p the more the
worst unit decides. Every episode counts twice, with the lifted functions' share larger and smaller by `deviation`: machines on which they act
more or less than on the mean machine look like that, and an observer that relied on what it was told of them would fail where others adapt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from .blocks import Array, Block, Model, Run, blocks_of, joined
from .past import THIN, Past, hidden_of, seen_by

_DAMPING = (1e-7, 1e-3, 1e4)
_SIDE_BY_SIDE = 8  # episodes: keeps derivatives in some ten megabytes
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
    power: float = 2.0,
    iterations: int = 25,
    least_gain: float = 3e-4,
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
    power : float
        p, at least 2.
    iterations : int
        Most steps.
    least_gain : float
        Decrease of the criterion below which the search ends.

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
    problem = _Tuning.of(past, states, inputs, units, parameters, importance, deviation, power)
    low, damping, high = _DAMPING
    blocks, slowest = blocks_of(*model), max(float(np.abs(np.linalg.eigvals(model[0])).max()), 1 - _MEMORIES / len(states))
    if not slowest < 1:
        raise DataError("Tuning an observer with memory: the model is not stable; start from one that is.")
    error = problem.errors(blocks)
    criterion = [problem.criterion(error)]
    for _ in range(iterations):
        blocks = blocks_of(*joined(blocks))
        H, g = problem.normal_equations(blocks, error)
        size = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
        H, g = H / np.outer(size, size), g / size
        while damping <= high:
            step = np.split(np.linalg.solve(H + damping * np.eye(len(g)), g) / size, np.cumsum([b.size for b in blocks])[:-1])
            trial = [b.moved(s).within(slowest) for b, s in zip(blocks, step, strict=True)]
            error_then = problem.errors(trial)
            if problem.criterion(error_then) < criterion[-1]:
                break
            damping *= 4
        else:
            break
        blocks, error, damping = trial, error_then, max(damping / 10, low)
        criterion.append(problem.criterion(error))
        if criterion[-2] - criterion[-1] < least_gain:
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
    power: float

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
        power: float,
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
        return cls(z, truth, rest, unit, share / share.sum(), power)

    def errors(self, blocks: Sequence[Block]) -> Array:
        """Mean square errors, shape (unit, h)."""
        found, counts = np.zeros((self.unit.max() + 1, len(self.truth))), np.bincount(self.unit)
        with np.errstate(over="ignore", invalid="ignore"):
            for part in self._parts():
                missed = self._missed(blocks, part)[1]
                np.add.at(found, self.unit[part], np.mean(missed**2, axis=-1).T)
        return found / counts[:, None]

    def criterion(self, error: Array) -> float:
        """The criterion of mean square errors by unit; infinite where the model diverges."""
        if not np.isfinite(error).all():
            return np.inf
        return float(self.share @ np.log(np.mean(error ** (self.power / 2), axis=0)) / self.power)

    def normal_equations(self, blocks: Sequence[Block], error: Array) -> tuple[Array, Array]:
        """Gauss-Newton matrix and right side for all coefficients of all blocks."""
        counts = np.bincount(self.unit)[:, None]
        weight = self.share * error ** (self.power / 2 - 1) / np.sum(error ** (self.power / 2), axis=0) / counts
        rows = np.arange(0, self.z.shape[-1], THIN)
        size = sum(b.size for b in blocks)
        H, g = np.zeros((size, size)), np.zeros(size)
        for part in self._parts():
            runs, missed = self._missed(blocks, part)
            root = np.sqrt(weight[self.unit[part]].T / len(rows))[..., None].astype(np.float32)
            slopes = np.concatenate([b.slopes(run, rows) for b, run in zip(blocks, runs, strict=True)])
            slopes *= root
            X = slopes.reshape(size, -1)
            H += X @ X.T
            g += X @ (missed[..., rows] * root).astype(np.float32).ravel()
        return H, g

    def _missed(self, blocks: Sequence[Block], part: slice) -> tuple[list[Run], Array]:
        """Runs of all blocks on some episodes, and what their estimates miss."""
        runs = [b.run(self.z[:, part], self.rest[:, part]) for b in blocks]
        estimate = sum(np.tensordot(b.H, run.h, 1) for b, run in zip(blocks, runs, strict=True))
        return runs, np.asarray(self.truth[:, part] - estimate)

    def _parts(self) -> list[slice]:
        return [slice(i, i + _SIDE_BY_SIDE) for i in range(0, len(self.unit), _SIDE_BY_SIDE)]
