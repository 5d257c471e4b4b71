r"""Tuning of linear models for hidden states: all coefficients, dynamics included, by Gauss-Newton steps.

The estimates are ``x_h = H (q I - F)^-1 G z`` with z as recorded (`PastMoments.channels`): no observer has to be run for a step. The criterion is

.. math:: \sum_{i, c} s_{ic} \operatorname{mean}_{u \in c} \log \bigl( \overline{e_{iu}^2} \bigr)^{1/2},

with :math:`\overline{e_{iu}^2}` the mean square error of hidden state i on unit u in condition c. Every episode counts twice, with the lifted
functions larger and smaller by a share: machines on which they act more or less than on the mean machine look like that, and an observer that relied on
the mean machine's would fail there. Steps are taken in coordinates in which the states are white along the recordings, all coefficients free: of the
many models with the same estimates, the nearest one. In those of companion forms or of single modes the search ends early.

References
----------
T. McKelvey, A. Helmersson and T. Ribarits, "Data driven local coordinates for multivariable linear systems and their application to system
identification", Automatica 40 (2004) 1629-1635.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...data import EpisodeBatch
from ..tuning.blocks import Array, Block, Model, blocks_of, estimates_along, joined, states_along
from ..tuning.gauss_newton import SETTLED, Damping, mean_log, scaled, search, whitening
from .free_start import FreeStart, in_motion
from .moments import PastMoments, Weights, hidden_of
from .sensitivities import Sensitivities

_DAMPING = Damping(1e-7, 1e-3, 1e4, 4.0)
_THIN, _SIDE_BY_SIDE = 8, 8  # episodes: keeps derivatives in some ten megabytes
_ROWS = 20  # samples for every coefficient that curvature is taken from: all samples make the gradient, so that it decides how fast, not where to
_TINY = np.finfo(float).tiny
_ALIKE = 1e-13  # share of a direction below which rounding decides
_SIZED = 16  # episodes that say how large errors are
_BOUND, _AT_BOUND = 1e4, 1 - 1e-6  # a pole at its bound stays there instead of ending the search


def tune_predictor(
    model: Model,
    past: PastMoments,
    batch: EpisodeBatch,
    importance: npt.ArrayLike = 1.0,
    deviation: float = 0.0,
    slowest: float | None = None,
    iterations: int = 25,
    least_gain: float = 1e-4,
    weights: Weights | None = None,
) -> tuple[Model, tuple[float, ...]]:
    """Improve a model of `PastMoments.model` on recordings of one length."""
    problem = _Tuning(past, batch, importance, deviation, weights)
    own = float(np.abs(np.linalg.eigvals(model[0])).max())
    problem.slowest = max(own, 1 - SETTLED / len(batch.states) if slowest is None else slowest)
    if not problem.slowest < 1:
        raise DataError("Tuning a predictor: the model is not stable; start from one that is.")
    blocks = blocks_of(*model)
    some = list(range(0, len(problem.group), -(-len(problem.group) // _SIZED)))
    problem.weights = FreeStart.by_size(problem.missed(blocks, some, None))
    found, criterion = search(problem.at(blocks), problem.steps, _DAMPING, iterations, least_gain, patience=2)
    return joined(found.blocks), criterion


@dataclass(frozen=True, eq=False)
class _Point:
    """A model in blocks, and its mean square errors, shape (group, h)."""

    blocks: list[Block]
    errors: Array
    criterion: float


class _Tuning:
    """Recordings to tune on, samples on the last axis."""

    def __init__(
        self,
        past: PastMoments,
        batch: EpisodeBatch,
        importance: npt.ArrayLike,
        deviation: float,
        weights: Weights | None,
    ) -> None:
        hidden = hidden_of(past.lifting, past.measured)
        seen, truth = past.channels(batch), batch.states[..., hidden]
        z, truth = (np.ascontiguousarray(np.moveaxis(a, 0, 2).swapaxes(0, 1)) for a in (seen, truth))
        own = [(key.unit, key.condition) if weights else ("", "") for key in batch.keys]
        names = list(dict.fromkeys(own))
        group, units = np.array([names.index(name) for name in own]), np.unique(batch.units, return_inverse=True)[1]
        lifted = slice(len(z) - len(past.lifting.functions), None)
        if deviation and past.lifting.functions:  # twice where machines deviate
            sign = np.where(np.arange(len(group)) % 2 == 0, deviation, -deviation)[:, None]
            both = [z.copy(), z.copy()]
            both[0][lifted] *= 1 + sign
            both[1][lifted] *= 1 - sign
            z, truth, group, units = (
                np.concatenate(both, axis=1),
                np.concatenate([truth, truth], axis=1),
                np.tile(group, 2),
                np.tile(units, 2),
            )
        conditions = [condition for _, condition in names]
        counts = np.array(
            [
                np.broadcast_to(np.asarray((weights or {"": 1.0}).get(c, 0.0), dtype=float), len(hidden))
                / conditions.count(c)
                for c in conditions
            ]
        )
        share = np.broadcast_to(np.asarray(importance, dtype=float), len(hidden)) * counts / counts.sum(axis=0)
        self.z, self.truth, self.group, self.share, self.slowest = z, truth, group, share / share.sum(), 1.0
        rows = list(zip(group.tolist(), units.tolist(), strict=True))
        self.each = _alike(rows)
        first = [i for i in range(len(rows)) if not weights or i % len(own) == rows.index(rows[i])]
        each = _alike([rows[i] for i in first])
        self.curved = [
            (first[i : i + _SIDE_BY_SIDE], each[i : i + _SIDE_BY_SIDE]) for i in range(0, len(first), _SIDE_BY_SIDE)
        ]
        self.rest = np.zeros(z.shape[:2])
        self.rest[lifted] = z[lifted, :, 0]
        self.free = in_motion(batch.states[..., hidden])
        self.weights = np.ones(len(hidden))

    def at(self, blocks: list[Block]) -> _Point:
        """Run a model."""
        found = np.zeros(self.share.shape)
        with np.errstate(over="ignore", invalid="ignore"):
            free = self._free(blocks)
            for part in self._parts():
                np.add.at(
                    found,
                    self.group[part],
                    np.mean(self.missed(blocks, part, free) ** 2, axis=-1).T * self.each[part, None],
                )
            return _Point(blocks, found, mean_log(self.share.ravel(), found.ravel()))

    def steps(self, point: _Point) -> Callable[[float], _Point]:
        """Gauss-Newton steps, bounded where they slow down the slowest pole."""
        blocks, model = point.blocks, joined(point.blocks)
        n, outputs = len(model[0]), len(self.truth)
        free = self._free(blocks)
        into, out = self._whitening(point, free)
        width, back = into.shape[1], np.linalg.pinv(out)
        weight = (self.share / np.maximum(point.errors, _TINY))[self.group]
        parameters = n * (width + outputs)
        every = max(
            1, int(self.truth[0, 0].size * sum(len(part) for part, _ in self.curved) * outputs / (_ROWS * parameters))
        )

        def turned(rows: Array) -> Array:
            """Coefficients, rows, in directions that are those of white states."""
            inner, direct = np.split(rows.reshape(len(rows), -1), [n * width])
            inner = np.tensordot(back, inner.reshape(n, width, -1), 1).reshape(-1, inner.shape[1])
            direct = np.einsum("nk,onr->okr", out, direct.reshape(outputs, n, -1)).reshape(-1, direct.shape[1])
            return np.concatenate([inner, direct])

        H = (
            self._curvature(blocks, weight, into, every)
            if free is None
            else self._curvature_of_free(blocks, free, weight, into, every)
        )
        H, g, size = scaled(
            turned(turned(H).T), turned(self._gradient(point, free, weight * self.each[:, None], into))[:, 0]
        )
        slows = np.hstack([_slowing(model[0]), np.zeros((n, len(self.z)))]) @ into
        outward = turned(np.concatenate([slows.ravel(), np.zeros(outputs * n)]))[:, 0] / size
        outward /= np.linalg.norm(outward)
        radius = max(float(np.abs(np.linalg.eigvals(b.F)).max()) for b in blocks)
        bounded = np.outer(outward, outward) * _BOUND if radius > self.slowest * _AT_BOUND else np.zeros_like(H)

        def trial(damping: float) -> _Point:
            damped = H + damping * np.eye(len(g))
            step = np.linalg.solve(damped, g)
            if outward @ step > 0:
                step = np.linalg.solve(damped + bounded, g)
            inner, direct = np.split(step / size, [len(back) * width])
            moved = back.T @ inner.reshape(-1, width) @ into.T
            changed = model[0] + moved[:, :n], model[1] + moved[:, n:], model[2] + direct.reshape(outputs, -1) @ out.T
            return self.at([b.within(self.slowest) for b in blocks_of(*changed)])

        return trial

    def _curvature(self, blocks: Sequence[Block], weight: Array, into: Array, every: int) -> Array:
        """Weighted products of what all coefficients do to the estimates, shape (parameters, parameters)."""
        sensitive = Sensitivities(blocks, np.flatnonzero(self.rest.any(axis=1)).tolist())
        part, each = (np.concatenate(of) for of in zip(*self.curved, strict=True))
        signals = sensitive.signals(self.z[:, part], self.rest[:, part], every)
        inner = np.einsum("oisk,sw->oiwk", sensitive.responses, into, optimize=True)
        direct = np.zeros((len(inner), len(inner), *sensitive.states.shape))
        direct[range(len(inner)), range(len(inner))] = sensitive.states
        found = 0.0
        for own, others, root in zip(inner, direct, np.sqrt(weight[part].T * each / signals.shape[-1]), strict=True):
            R = np.linalg.qr((signals * root[:, None]).reshape(len(signals), -1).T, mode="r")
            rows = R @ np.concatenate([one.reshape(-1, len(signals)) for one in (own, others)]).T
            found = found + rows.T @ rows
        return np.asarray(found)

    def _curvature_of_free(
        self, blocks: Sequence[Block], free: FreeStart, weight: Array, into: Array, every: int
    ) -> Array:
        """The same where every recording has a start of its own, which moves the states that coefficients multiply."""
        outputs, n = len(self.truth), len(into) - len(self.z)
        H = np.zeros((n * (into.shape[1] + outputs),) * 2)
        for part, each in self.curved:
            h, rest = self.states(blocks, part, free)
            signals = np.tensordot(into.T, np.concatenate([h, self.z[:, part]]), 1)
            rest = np.tensordot(into.T, np.concatenate([rest, self.rest[:, part]]), 1)
            inner = free.without(np.concatenate([b.responses(signals, rest, every) for b in blocks]), every)
            direct = np.zeros((outputs, *h[..., ::every].shape[:1], outputs, *h[..., ::every].shape[1:]))
            direct[range(outputs), :, range(outputs)] = h[..., ::every]
            root = np.sqrt(weight[part].T * each / h[0, 0, ::every].size)[..., None]
            X = np.concatenate(
                [(part_of * root).reshape(-1, root[..., 0].size * inner.shape[-1]) for part_of in (inner, direct)]
            )
            H += X @ X.T
        return H

    def _gradient(self, point: _Point, free: FreeStart | None, weight: Array, into: Array) -> Array:
        """How fast the weighted squares fall with all coefficients, of all recordings and samples."""
        blocks = point.blocks
        inner, direct = (
            np.zeros((sum(len(b.F) for b in blocks), len(into))),
            np.zeros((len(self.truth), sum(len(b.F) for b in blocks))),
        )
        F, _, H = joined(blocks)
        backwards = [Block(b.F.T, b.H.T, b.H) for b in blocks]
        for part in self._parts():
            h, rest = self.states(blocks, part, free)
            missed = self.truth[:, part] - np.tensordot(H, h, 1)
            missed *= (weight[part].T / missed.shape[-1])[..., None]
            if free is not None:
                missed = free.back(missed)
            signals, resting = np.concatenate([h, self.z[:, part]]), np.concatenate([rest, self.rest[:, part]])
            direct += np.tensordot(missed, h, ((1, 2), (1, 2)))
            back = missed[..., ::-1]
            later = states_along(backwards, back, np.zeros(back.shape[:2]))[0]
            last = F.T @ later[..., -1] + H.T @ back[..., -1]
            inner += np.tensordot(later[..., ::-1], signals, ((1, 2), (1, 2)))
            inner += np.linalg.solve(np.eye(len(F)) - F.T, last) @ resting.T
        return np.concatenate([(inner @ into).ravel(), direct.ravel()])

    def _whitening(self, point: _Point, free: FreeStart | None) -> tuple[Array, Array]:
        """What makes all states and channels white along the recordings, and what makes the states so."""
        n = sum(len(b.F) for b in point.blocks)
        moments = np.zeros((n + len(self.z),) * 2)
        for part in self._parts():
            h = self.states(point.blocks, part, free, _THIN)[0]
            flat = np.concatenate([h, self.z[:, part, ::_THIN]]).reshape(len(moments), -1)
            moments += flat @ flat.T
        moments *= _THIN / self.z[0].size
        return whitening(moments, _ALIKE), whitening(moments[:n, :n], _ALIKE)

    def missed(self, blocks: Sequence[Block], part: slice | list[int], free: FreeStart | None) -> Array:
        """Return what the estimates miss on some episodes, shape (h, batch, n_samples)."""
        missed = self.truth[:, part] - estimates_along(blocks, self.z[:, part], self.rest[:, part])
        return missed if free is None else free.without(missed)

    def states(
        self, blocks: Sequence[Block], part: slice | list[int], free: FreeStart | None, every: int = 1
    ) -> tuple[Array, Array]:
        """Return states of all blocks on some episodes, shape (n, batch, n_samples / every), and their rest, shape (n, batch)."""
        h, rest = states_along(blocks, self.z[:, part], self.rest[:, part], every)
        if free is not None:
            h += free.moved(
                free.fitted(self.truth[:, part] - estimates_along(blocks, self.z[:, part], self.rest[:, part])), every
            )
        return h, rest

    def _free(self, blocks: Sequence[Block]) -> FreeStart | None:
        """What starts of their own do, where recordings begin in motion."""
        F, _, H = joined(blocks)
        return FreeStart.of(F, H, self.z.shape[-1], self.weights) if self.free else None

    def _parts(self) -> list[slice]:
        return [slice(i, i + _SIDE_BY_SIDE) for i in range(0, len(self.group), _SIDE_BY_SIDE)]


def _alike(rows: Sequence[tuple[int, int]]) -> Array:
    """Weights of recordings, of which each is of a group and a unit, so that all units of a group count alike, with sum one in every group."""
    units = {group: len({u for g, u in rows if g == group}) for group, _ in rows}
    return np.array([1 / (rows.count(row) * units[row[0]]) for row in rows])


def _slowing(F: Array) -> Array:
    """Derivative of the spectral radius by F, shape (n, n)."""
    values, vectors = np.linalg.eig(F)
    k = int(np.abs(values).argmax())
    turn = np.conj(values[k]) / np.abs(values[k])
    return np.asarray((turn * np.outer(np.linalg.inv(vectors)[k], vectors[:, k])).real)
