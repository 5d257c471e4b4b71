r"""Linear models in real blocks of one or two states: their estimates along recordings, and how these change with every coefficient.

A model ``h+ = F h + G z``, ``x_h = H h`` is a sum of blocks of its own. Of a block

.. math:: (q I - F)^{-1} = \frac{I - q^{-1}(\operatorname{tr} F \, I - F)}{q - \operatorname{tr} F + q^{-1} \det F}

(for one state: 1 / (q - F)), so that signals through one scalar filter make up its states and, filtered once more, all derivatives of the estimates.
What came before the first sample is taken to have been constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag
from scipy.signal import lfilter

Array = npt.NDArray[np.float64]
Model = tuple[Array, Array, Array]
_REAL = 1e-9


@dataclass(frozen=True, eq=False)
class Block:
    """A model of one or two states: F (d, d), G (d, channels), H (h, d)."""

    F: Array
    G: Array
    H: Array

    @property
    def size(self) -> int:
        """Coefficients."""
        return self.F.size + self.G.size + self.H.size

    @property
    def _behind(self) -> Array:
        return np.trace(self.F) * np.eye(2) - self.F if len(self.F) == 2 else np.zeros((1, 1))

    def within(self, radius: float) -> Block:
        """Return the block with its eigenvalues scaled into a circle."""
        largest = np.abs(np.linalg.eigvals(self.F)).max()
        return self if largest <= radius else Block(self.F * (radius / largest), self.G, self.H)

    def moved(self, step: Array) -> Block:
        """Return the block with all its coefficients moved, in the order of `slopes`."""
        n, width = len(self.F), len(self.F) + self.G.shape[1]
        rows, H = step[: n * width].reshape(n, width), step[n * width :].reshape(self.H.shape)
        return Block(self.F + rows[:, :n], self.G + rows[:, n:], self.H + H)

    def run(self, z: Array, rest: Array) -> Run:
        """Run along channels z (channels, batch, n_samples) that were `rest` (channels, batch) before."""
        held, held_rest, late = self._through(z, rest)
        at_once, before = self.G, self._behind @ self.G
        h = np.tensordot(at_once, held, 1) - np.tensordot(before, late, 1)
        return Run(held, late, h, np.tensordot(at_once - before, held_rest, 1))

    def slopes(self, run: Run, rows: npt.NDArray[np.intp]) -> npt.NDArray[np.float32]:
        """Return the derivatives of the estimates by F and G, row by row, and H: shape (size, h, batch, rows)."""
        held, _, late = self._through(run.h, run.rest)
        now = np.concatenate([held[..., rows], run.held[..., rows]]).astype(np.float32)
        before = np.concatenate([late[..., rows], run.late[..., rows]]).astype(np.float32)
        behind, (outputs, n) = self.H @ self._behind, self.H.shape
        found = np.zeros((self.size, outputs, *now.shape[1:]), np.float32)
        through = found[: n * len(now)].reshape(n, len(now), outputs, *now.shape[1:])
        for i, o in np.ndindex(n, outputs):
            through[i, :, o] = np.float32(self.H[o, i]) * now - np.float32(behind[o, i]) * before
        direct = found[n * len(now) :].reshape(outputs, n, outputs, *now.shape[1:])
        for o in range(outputs):
            direct[o, :, o] = run.h[..., rows]
        return found

    def _through(self, signals: Array, rest: Array) -> tuple[Array, Array, Array]:
        """Signals through the scalar filter, their rest, and the same one sample later."""
        F = self.F
        poles = np.array([1.0, -F[0, 0]] if len(F) == 1 else [1.0, -np.trace(F), np.linalg.det(F)])
        at_rest = rest / poles.sum()
        held = lfilter([0.0, 1.0], poles, signals - rest[..., None]) + at_rest[..., None]
        return held, at_rest, np.concatenate([at_rest[..., None], held[..., :-1]], axis=-1)


@dataclass(frozen=True, eq=False)
class Run:
    """Signals of a block along recordings: channels through its scalar filter, now and a sample late, its states, and these at rest."""

    held: Array
    late: Array
    h: Array
    rest: Array


def blocks_of(F: Array, G: Array, H: Array) -> list[Block]:
    """Split a model into blocks: pairs of conjugate eigenvalues, and real ones two by two."""
    values, vectors = np.linalg.eig(F)
    upper = np.flatnonzero(values.imag > _REAL)
    real = np.flatnonzero(np.abs(values.imag) <= _REAL)
    real = real[np.argsort(values[real].real)]
    columns: list[Any] = [part for i in upper for part in (vectors[:, i].real, vectors[:, i].imag)]
    columns += [vectors[:, i].real for i in real]
    turn = np.stack(columns, axis=1)
    f, g, h = np.linalg.solve(turn, F @ turn), np.linalg.solve(turn, G), H @ turn
    starts = range(0, len(F), 2)
    return [Block(f[i : i + 2, i : i + 2].copy(), g[i : i + 2].copy(), h[:, i : i + 2].copy()) for i in starts]


def joined(blocks: Sequence[Block]) -> Model:
    """Return one model of all blocks."""
    return (
        np.asarray(block_diag(*(b.F for b in blocks))),
        np.vstack([b.G for b in blocks]),
        np.hstack([b.H for b in blocks]),
    )
