r"""Linear models in real blocks of one or two states: their estimates along recordings, and how these change with every coefficient.

A model ``h+ = F h + G z``, ``x_h = H h`` is a sum of blocks of its own. Of a block

.. math:: (q I - F)^{-1} = \frac{I - q^{-1}(\operatorname{tr} F \, I - F)}{q - \operatorname{tr} F + q^{-1} \det F}

(for one state: 1 / (q - F)), so that signals through one scalar filter make up its states and, filtered once more, what any change of F and G
does to the estimates.
What came before the first sample is taken to have been constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...loops import blocks_along, filtered

Array = npt.NDArray[np.float64]
Model = tuple[Array, Array, Array]
_PARALLEL, _NUDGE = 1e8, 1e-6


@dataclass(frozen=True, eq=False)
class Block:
    """A model of one or two states: F (d, d), G (d, channels), H (h, d)."""

    F: Array
    G: Array
    H: Array

    @property
    def _poles(self) -> tuple[float, float]:
        F = self.F
        return (-float(F[0, 0]), 0.0) if len(F) == 1 else (-float(np.trace(F)), float(np.linalg.det(F)))

    @property
    def behind(self) -> Array:
        """``tr F I - F``, what multiplies the filtered signal of one sample before; zero for one state."""
        return np.trace(self.F) * np.eye(2) - self.F if len(self.F) == 2 else np.zeros((1, 1))

    def within(self, radius: float) -> Block:
        """Return the block with its eigenvalues scaled into a circle."""
        largest = np.abs(np.linalg.eigvals(self.F)).max()
        return self if largest <= radius else Block(self.F * (radius / largest), self.G, self.H)

    def responses(self, signals: Array, rest: Array, every: int) -> Array:
        """Return what signals added to each of its states do to the estimates, shape (d, signals, h, batch, n_samples / every)."""
        now, before = filtered(signals, rest, *self._poles, every)
        behind, (outputs, n) = self.H @ self.behind, self.H.shape
        found = np.empty((n, len(now), outputs, *now.shape[1:]))
        for i, o in np.ndindex(n, outputs):
            found[i, :, o] = self.H[o, i] * now - behind[o, i] * before
        return found


def states_along(blocks: Sequence[Block], z: Array, rest: Array, every: int = 1) -> tuple[Array, Array]:
    """Return the states of a model along channels, at every so many samples, and at rest; z (channels, batch, n_samples)."""
    F, G, H = _in_pairs(blocks)
    held, n = _held(F, G, rest), sum(len(b.F) for b in blocks)
    return blocks_along(F, G, H, z, rest, held, every)[:n], held.reshape(-1, rest.shape[1])[:n]


def estimates_along(blocks: Sequence[Block], z: Array, rest: Array) -> Array:
    """Return the estimates of a model along channels, shape (h, batch, n_samples); `z` and `rest` as in `states_along`."""
    F, G, H = _in_pairs(blocks)
    return blocks_along(F, G, H, z, rest, _held(F, G, rest), states=False)


def _in_pairs(blocks: Sequence[Block]) -> Model:
    """Blocks side by side, shapes (b, 2, 2), (b, 2, channels), (h, b, 2); one of one state has a second one that nothing moves."""
    F, G, H = (
        np.zeros((len(blocks), 2, 2)),
        np.zeros((len(blocks), 2, blocks[0].G.shape[1])),
        np.zeros((len(blocks[0].H), len(blocks), 2)),
    )
    for i, b in enumerate(blocks):
        own = slice(len(b.F))
        F[i, own, own], G[i, own], H[:, i, own] = b.F, b.G, b.H
    return F, G, H


def _held(F: Array, G: Array, rest: Array) -> Array:
    return np.asarray(np.linalg.solve(np.eye(2) - F, G @ rest))


def moved(blocks: Sequence[Block], signals: Array, every: int, first: int) -> Array:
    """Return responses of a model's estimates to signals (signals, batch, n_samples) in each of its channels."""
    kept, rest = -(-signals.shape[-1] // every) - first, np.zeros(signals.shape[:2])
    held = np.empty((len(signals), 2 * len(blocks), signals.shape[1], kept))
    for i, block in enumerate(blocks):
        for j, one in enumerate(filtered(signals, rest, *block._poles, every)):
            held[:, 2 * i + j] = one[..., first:]
    share = np.stack(
        [part for b in blocks for part in (b.H @ b.G, -b.H @ b.behind @ b.G)], axis=-1
    )  # (h, channels, 2 * blocks)
    return np.asarray(share.swapaxes(0, 1)[:, None] @ held.reshape(*held.shape[:2], -1))


def blocks_of(F: Array, G: Array, H: Array) -> list[Block]:
    """Split a model into blocks: pairs of conjugate eigenvalues, and real ones two by two."""
    turn = _modes(F)
    if not np.linalg.cond(turn) < _PARALLEL:
        F = F + _NUDGE * np.random.default_rng(0).normal(size=F.shape)
        turn = _modes(F)
    back = np.asarray(np.linalg.inv(turn), dtype=float)
    f, g, h = back @ F @ turn, back @ G, H @ turn
    return [
        Block(f[i : i + 2, i : i + 2].copy(), g[i : i + 2].copy(), h[:, i : i + 2].copy()) for i in range(0, len(F), 2)
    ]


def _modes(F: Array) -> Array:
    values, vectors = np.linalg.eig(F)
    upper, real = np.flatnonzero(values.imag > 0), np.flatnonzero(values.imag == 0)
    pairs = [part for i in upper for part in (vectors[:, i].real, vectors[:, i].imag)]
    return np.stack([*pairs, *(vectors[:, i].real for i in real[np.argsort(values[real].real)])], axis=1)


def joined(blocks: Sequence[Block]) -> Model:
    """Return one model of all blocks."""
    from scipy.linalg import block_diag

    return (
        np.asarray(block_diag(*(b.F for b in blocks))),
        np.vstack([b.G for b in blocks]),
        np.hstack([b.H for b in blocks]),
    )
