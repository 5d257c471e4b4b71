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
    """Responses of a model's estimates to additions to its states, and its states themselves, in a common basis.

    Parameters
    ----------
    blocks : sequence of Block
        Of a stable model.
    resting : sequence of int
        Channels that were not zero before.

    Attributes
    ----------
    responses : ndarray, shape (outputs, n, n + channels, signals)
        What every state and every channel, added to every state, does to the estimates.
    states : ndarray, shape (n, signals)
    """

    def __init__(self, blocks: Sequence[Block], resting: Sequence[int]) -> None:
        from scipy.linalg import block_diag

        self._resting = list(resting)
        self._reflections = np.repeat([_reflections(b.F) for b in blocks], 2, axis=0)
        A, B = lattice(self._reflections)
        F, G, H = joined(blocks)
        (n, channels), order = G.shape, len(A)
        self._order, self._channels = order, channels
        own = np.repeat(np.arange(len(blocks)), [len(b.F) for b in blocks])  # block of every state
        poles = np.stack([np.resize(np.append(np.linalg.eigvals(b.F), 0.0), 2) for b in blocks])

        def through(right: Array) -> Array:
            """Solve with every block's characteristic polynomial of A, one eigenvalue at a time, which keeps what slow poles would lose."""
            first, second = (np.eye(order) - poles[:, i, None, None] * A for i in range(2))
            return np.asarray(np.linalg.solve(second, np.linalg.solve(first, right)).real)

        behind = block_diag(*(b.behind for b in blocks))
        impulse = through(B[None, :, None])[..., 0]  # (block, order)
        states = np.einsum("ic,ik->ick", G, impulse[own]) - np.einsum("ic,ik->ick", behind @ G, (impulse @ A.T)[own])  # Y
        driven = through((A @ states.reshape(-1, order).T)[None])  # (block, order, n * channels)
        driven = np.stack([driven, A @ driven]).reshape(2, len(blocks), order, n, channels)
        impulses = np.stack([impulse, impulse @ A.T])
        share = np.stack([H, -H @ behind])
        signals = np.zeros((len(H), n, n + channels, channels, order))
        signals[:, :, :n] = np.einsum("zoi,zikjc->oijck", share, driven[:, own], optimize=True)
        direct = np.einsum("zoi,zik->oik", share, impulses[:, own])
        for c in range(channels):
            signals[:, :, n + c, c] = direct
        held = np.linalg.solve(np.eye(n) - F, np.hstack([G, np.eye(n)]))
        settled, at_rest = H @ held[:, channels:], np.hstack([held[:, :channels].T, np.eye(channels)])  # (channels, n + channels)
        constant = np.einsum("oi,cs->oisc", settled, at_rest[self._resting])
        self.responses = np.concatenate([signals.reshape(*signals.shape[:3], -1), constant], axis=-1)
        self.states = np.concatenate([states.reshape(n, -1), held[:, self._resting]], axis=-1)

    def signals(self, z: Array, rest: Array, every: int) -> Array:
        """Return the signals that make up everything, shape (signals, batch, n_samples / every).

        Parameters
        ----------
        z : ndarray, shape (channels, batch, n_samples)
        rest : ndarray, shape (channels, batch)
            What z was before.
        every : int
        """
        moving = (z - rest[..., None]).reshape(-1, z.shape[-1])
        found = lattice_along(self._reflections, moving, every)
        found = found.reshape(self._order, self._channels, -1, found.shape[-1]).swapaxes(0, 1)
        held = np.broadcast_to(rest[self._resting][..., None], (len(self._resting), *found.shape[2:]))
        return np.concatenate([found.reshape(-1, *found.shape[2:]), held])


def _reflections(F: Array) -> tuple[float, float]:
    """Coefficients k1, k2 of the lattice with a block's eigenvalues."""
    if len(F) == 1:
        return -float(F[0, 0]), np.nan
    det = float(np.linalg.det(F))
    return -float(np.trace(F)) / (1 + det), det
