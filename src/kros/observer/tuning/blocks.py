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
    def _behind(self) -> Array:
        return np.trace(self.F) * np.eye(2) - self.F if len(self.F) == 2 else np.zeros((1, 1))

    def within(self, radius: float) -> Block:
        """Return the block with its eigenvalues scaled into a circle."""
        largest = np.abs(np.linalg.eigvals(self.F)).max()
        return self if largest <= radius else Block(self.F * (radius / largest), self.G, self.H)

    def run(self, z: Array, rest: Array) -> tuple[Array, Array]:
        """Return the states h along channels z (channels, batch, n_samples) that were `rest` (channels, batch) before, and at rest."""
        behind = self._behind
        h, held_rest = self._through(np.tensordot(self.G, z, 1), self.G @ rest)
        before = np.tensordot(behind, h[..., :-1], 1)
        h[..., 1:] -= before
        h[..., 0] -= behind @ held_rest
        return h, held_rest - behind @ held_rest

    def responses(self, signals: Array, rest: Array, every: int) -> Array:
        """Return what signals added to each of its states do to the estimates, shape (d, signals, h, batch, n_samples / every)."""
        held, held_rest = self._through(signals, rest)
        now = held[..., ::every]
        before = np.concatenate([held_rest[..., None], held[..., every - 1 : -1 : every]], axis=-1)[..., : now.shape[-1]]
        behind, (outputs, n) = self.H @ self._behind, self.H.shape
        found = np.empty((n, len(now), outputs, *now.shape[1:]))
        for i, o in np.ndindex(n, outputs):
            found[i, :, o] = self.H[o, i] * now - behind[o, i] * before
        return found

    def _through(self, signals: Array, rest: Array) -> tuple[Array, Array]:
        """Signals through the scalar filter, and their rest."""
        from scipy.signal import lfilter

        F = self.F
        poles = np.array([1.0, -F[0, 0]] if len(F) == 1 else [1.0, -np.trace(F), np.linalg.det(F)])
        at_rest = rest / poles.sum()
        held = np.asarray(lfilter([0.0, 1.0], poles, signals - rest[..., None]))
        held += at_rest[..., None]
        return held, at_rest


def blocks_of(F: Array, G: Array, H: Array) -> list[Block]:
    """Split a model into blocks: pairs of conjugate eigenvalues, and real ones two by two.

    Where eigenvectors are nearly parallel, as those of delays, F is moved by a millionth first.
    """
    turn = _modes(F)
    if not np.linalg.cond(turn) < _PARALLEL:
        F = F + _NUDGE * np.random.default_rng(0).normal(size=F.shape)
        turn = _modes(F)
    back = np.asarray(np.linalg.inv(turn), dtype=float)
    f, g, h = back @ F @ turn, back @ G, H @ turn
    return [Block(f[i : i + 2, i : i + 2].copy(), g[i : i + 2].copy(), h[:, i : i + 2].copy()) for i in range(0, len(F), 2)]


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
