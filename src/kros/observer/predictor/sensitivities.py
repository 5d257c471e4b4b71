r"""What the coefficients of a model in blocks do to its estimates: few signals make up all of them.

A coefficient of F adds a state to a state, and both are filtered channels: what it does to an estimate is a channel through a product of two of the
model's poles' filters. All these products lie in the space of each pole taken twice. In an orthonormal basis phi of that space (Takenaka and Malmquist;
here a chain of normalised lattices), of twice as many states as the model has, the response to any coefficient is ``P phi`` for one driven channel, where

.. math:: P = F P A' + e_i Y_j A', \qquad Y = F Y A' + G B'

for phi+ = A phi + B z and h = Y phi. With the blocks' own characteristic polynomials these Stein equations are linear ones of phi's order. So responses to
some thousand coefficients along recordings follow from those of a hundred signals, and no product of pairs of long responses is needed.

References
----------
P. S. C. Heuberger, P. M. J. Van den Hof, B. Wahlberg (eds.), "Modelling and Identification with Rational Orthogonal Basis Functions", Springer (2005).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ...loops import lattice, lattice_along
from ..tuning.blocks import Block, joined

Array = npt.NDArray[np.float64]


class Sensitivities:
    """Responses of a model's estimates to additions to its states, and its states themselves, in a common basis."""

    def __init__(self, blocks: Sequence[Block], resting: Sequence[int]) -> None:
        from scipy.linalg import block_diag

        F, G, H = joined(blocks)
        self._resting, self._channels = list(resting), G.shape[1]
        self._reflections = np.repeat([_reflections(b.F) for b in blocks], 2, axis=0)
        A, B = lattice(self._reflections)
        (n, channels), order = G.shape, len(A)
        own = np.repeat(np.arange(len(blocks)), [len(b.F) for b in blocks])  # block of every state
        behind = block_diag(*(b.behind for b in blocks))
        solve = _Polynomials(blocks, A)
        # Channels through a block's filter, now and one sample before, then the states Y, which are sums of these.
        filtered = solve(B[None, :, None])[..., 0][own]  # (n, order)
        filtered = np.stack([filtered, filtered @ A.T])
        states = np.einsum("ic,ik->ick", G, filtered[0]) - np.einsum("ic,ik->ick", behind @ G, filtered[1])
        # The states through every block's filter again: what an addition of them to a state does.
        again = solve((A @ states.reshape(-1, order).T)[None])
        again = np.stack([again, A @ again]).reshape(2, len(blocks), order, n, channels)[:, own]
        share = np.stack([H, -H @ behind])
        responses = np.zeros((len(H), n, n + channels, channels, order))
        responses[:, :, :n] = np.einsum("zoi,zikjc->oijck", share, again, optimize=True)
        responses[:, :, range(n, n + channels), range(channels)] = np.einsum("zoi,zik->oik", share, filtered)[
            :, :, None
        ]
        # What was constant before the first sample stays so.
        held = np.linalg.solve(np.eye(n) - F, np.hstack([G, np.eye(n)]))
        at_rest = np.hstack([held[:, :channels].T, np.eye(channels)])[self._resting]
        constant = np.einsum("oi,cs->oisc", H @ held[:, channels:], at_rest)
        self.responses = np.concatenate([responses.reshape(*responses.shape[:3], -1), constant], axis=-1)
        self.states = np.concatenate([states.reshape(n, -1), held[:, self._resting]], axis=-1)

    def signals(self, z: Array, rest: Array, every: int) -> Array:
        """Return the signals that make up everything, shape (signals, batch, n_samples / every)."""
        moving = (z - rest[..., None]).reshape(-1, z.shape[-1])
        found = lattice_along(self._reflections, moving, every)
        found = found.reshape(len(found), self._channels, -1, found.shape[-1]).swapaxes(0, 1)
        held = np.broadcast_to(rest[self._resting][..., None], (len(self._resting), *found.shape[2:]))
        return np.concatenate([found.reshape(-1, *found.shape[2:]), held])


class _Polynomials:
    """Characteristic polynomials of all blocks at the basis's A."""

    def __init__(self, blocks: Sequence[Block], A: Array) -> None:
        poles = np.stack([np.resize(np.append(np.linalg.eigvals(b.F), 0.0), 2) for b in blocks])
        self._first, self._second = (np.eye(len(A)) - poles[:, i, None, None] * A for i in range(2))

    def __call__(self, right: Array) -> Array:
        """Solve for one right side, shape (1, order, k); one eigenvalue at a time keeps the digits that slow poles would lose."""
        return np.asarray(np.linalg.solve(self._second, np.linalg.solve(self._first, right)).real)


def _reflections(F: Array) -> tuple[float, float]:
    """Coefficients k1, k2 of the lattice with a block's eigenvalues."""
    if len(F) == 1:
        return -float(F[0, 0]), np.nan
    det = float(np.linalg.det(F))
    return -float(np.trace(F)) / (1 + det), det
