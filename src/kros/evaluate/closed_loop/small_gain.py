r"""Small gain with structure: how large the blocks of a perturbation may be around a loop, at all frequencies.

             +-- diag(Delta_1, Delta_2, ...) <--+
           w |                                  | z         stable for all ||Delta_i|| <= k  if  k mu(M) < 1
             +--------------> M ----------------+

.. math:: \rho(M \Delta) \;\le\; \mu(M) \;\le\; \bar\sigma(D M D^{-1}), \qquad D = \mathrm{diag}(d_i I)

The scalings d balance the norms of the blocks (Osborne), at every frequency anew. Between frequencies the right side
is proven: a scaling keeps the gain below a level up to the next frequencies at which the Hamiltonian matrix of this
level has eigenvalues on the axis, and such arcs cover the circle. The left side is a power iteration. Frequencies nu
are those after the bilinear map of `kros.core.norms`.

Sources: J. C. Doyle, IEE Proceedings D 129 (1982) 242-250; A. Packard, M. K. H. Fan and J. Doyle, CDC 1988.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...core import ITERATED, TINY, AnyArray, ArrayLike, Flags, StateSpace, frozen
from ...core.norms import balanced, crossings, first_frequencies, to_continuous

_STEPS = 60  # of iterations that end much earlier
_DECADES = 12  # of levels on both sides of one


@frozen
class Blocks:
    """A stable discrete system between the blocks of a perturbation; `sizes` are signals (w_i, z_i) of every block."""

    system: StateSpace
    sizes: Sequence[tuple[int, int]]

    @property
    def places(self) -> list[AnyArray]:
        """Block of every signal w, and of every signal z."""
        return [np.repeat(np.arange(len(self.sizes)), of_side) for of_side in zip(*self.sizes, strict=True)]

    @property
    def perturbation(self) -> Blocks:
        """The system between all blocks but the last one, which is about performance."""
        w, z = np.sum(self.sizes[:-1], axis=0)
        s = self.system
        return Blocks(StateSpace(s.A, s.B[:, :w], s.C[:z], s.D[:z, :w], s.dt), self.sizes[:-1])

    def over(self, level: float, which: Flags) -> Blocks:
        """Return the system with some outputs divided by a level."""
        system = self.system.multiplied(np.where(which, 1 / level, 1.0), np.ones(self.system.n_inputs))
        return replace(self, system=system)

    def at(self, nu: ArrayLike) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return M, (f, z, w), scalings that balance its blocks, and the scaled gains, (f,), at mapped frequencies."""
        nu, (w, z), k = np.atleast_1d(nu), self.places, range(len(self.sizes))
        M = self.system.frequency_response(np.arctan(nu) / (np.pi * self.system.dt))
        size = np.array([[np.linalg.norm(M[:, z == i][:, :, w == j], 2, (1, 2)) * (i != j) for j in k] for i in k])
        x = np.zeros(size.shape[1:])
        for _ in range(_STEPS):
            column, row = (np.log((size * np.exp(x[:, None] - x) + TINY).sum(axis=side)) for side in (0, 1))
            x += np.clip(column - row, -1, 1) / 4
        d = np.exp(x.T)
        return M, d, np.linalg.norm(M * d[:, z, None] / d[:, None, w], 2, (1, 2))

    def exceeding(self) -> float | None:
        """Return a mapped frequency at which the scaled gain is above one; None where there is none, proven."""
        s, (w, z) = balanced(to_continuous(self.system)), self.places
        nu = np.append(first_frequencies(s.poles()), np.inf)
        gains = self.at(nu)[2]
        worst = float(nu[np.argmax(gains)])
        if gains.max() > 1:
            return worst
        arcs = [(0.0, worst), (worst, np.inf)]
        while arcs:
            a, b = arcs.pop()
            middle = b if np.isinf(b) else float(np.sqrt(a * b))
            _, (d,), (gain,) = self.at(middle)
            if gain > 1:
                return middle
            ends = crossings(s.multiplied(d[z], 1 / d[w]), 1.0)
            low, high = ends[ends <= middle].max(initial=0.0), ends[ends > middle].min(initial=np.inf)
            arcs += [arc for arc in ((a, low), (high, b)) if arc[1] > arc[0] * (1 + ITERATED)]
        return None


def least_level(blocks: Blocks, which: Flags, tolerance: float) -> tuple[float, float]:
    """Return the least level that some outputs over it keep the scaled gain below one, and where a smaller one fails.

    Infinity where there is none.
    """
    most = round(_DECADES * np.log(10) / np.log1p(tolerance))
    levels = (1 + tolerance) ** np.arange(-most, most + 1.0)
    first = bisect_left(levels, True, key=lambda level: blocks.over(level, which).exceeding() is None)
    if first == len(levels):
        return np.inf, 0.0
    return float(levels[first]), blocks.over(levels[max(first - 1, 0)], which).exceeding() or 0.0


def attained(blocks: Blocks, nu: float) -> tuple[float, AnyArray]:
    """Return the largest ``rho(M Delta)`` that is found at a mapped frequency, and Delta, (w, z), of norm one."""
    from scipy.linalg import eig

    (w, z), ((M,), (d,), _) = blocks.places, blocks.at(nu)
    u, sigma, v = np.linalg.svd(M * d[z, None] / d[w], full_matrices=False)
    p, x, best = (sigma @ v).conj(), u @ sigma, (-1.0, M.T)  # equal singular values take part alike
    for _ in range(_STEPS):
        pieces = [np.outer(np.where(w == i, p, 0), np.where(z == i, x, 0).conj()) for i in range(len(blocks.sizes))]
        delta = np.sum([piece / max(np.linalg.norm(piece), TINY) for piece in pieces], axis=0)
        values, left, right = eig(M @ delta, left=True)
        k = int(np.argmax(np.abs(values)))
        size = float(np.abs(values[k]))
        if size > best[0]:
            best = size, delta * values[k].conj() / max(size, TINY)
        p, x = M.conj().T @ left[:, k], right[:, k]
    return best
