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

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from kros.core.arrays import AnyArray as Array
from kros.core.arrays import ArrayLike, frozen
from kros.core.errors import SynthesisError
from kros.core.lti import StateSpace
from kros.core.norms import balanced, crossings, first_frequencies, to_continuous
from kros.core.rounding import ITERATED, TINY

_STEPS = 60  # of iterations that end much earlier


@frozen
class Blocks:
    """A stable discrete system between the blocks of a perturbation; `sizes` are signals (w_i, z_i) of every block."""

    system: StateSpace
    sizes: Sequence[tuple[int, int]]

    @cached_property
    def _continuous(self) -> StateSpace:
        return balanced(to_continuous(self.system))

    @cached_property
    def frequencies(self) -> Array:
        """Mapped frequencies at which a search begins."""
        return np.append(first_frequencies(self._continuous.poles()), np.inf)

    @property
    def places(self) -> list[Array]:
        """Block of every signal w, and of every signal z."""
        return [np.repeat(np.arange(len(self.sizes)), of_side) for of_side in zip(*self.sizes, strict=True)]

    def part(self, count: int) -> Blocks:
        """Return the system between the first blocks alone."""
        (w, z), s = (place < count for place in self.places), self.system
        return Blocks(StateSpace(s.A, s.B[:, w], s.C[z], s.D[z][:, w], s.dt), self.sizes[:count])

    def at(self, nu: ArrayLike) -> tuple[Array, Array, Array]:
        """Return M, (f, z, w), scalings that balance its blocks, and the scaled gains, (f,), at mapped frequencies."""
        nu, (w, z), k = np.atleast_1d(nu), self.places, range(len(self.sizes))
        M = self._continuous.frequency_response(np.where(np.isinf(nu), 0.0, nu) / (2 * np.pi))
        M[np.isinf(nu)] = self._continuous.D
        size = np.array([[np.linalg.norm(M[:, z == i][:, :, w == j], 2, (1, 2)) * (i != j) for j in k] for i in k])
        x = np.zeros(size.shape[1:])
        for _ in range(_STEPS):
            column, row = (np.log((size * np.exp(x[:, None] - x) + TINY).sum(axis=side)) for side in (0, 1))
            x += np.clip(column - row, -1, 1) / 4
        d = np.exp(x.T)
        return M, d, np.linalg.norm(M * d[:, z, None] / d[:, None, w], 2, (1, 2))

    def exceeding(self, level: float) -> float | None:
        """Return a frequency at which the scaled gain is above a level; None where there is none, proven."""
        gains, s, (w, z) = self.at(self.frequencies)[2], self._continuous, self.places
        worst = float(self.frequencies[np.argmax(gains)])
        if gains.max() > level:
            return worst
        arcs = [(0.0, worst), (worst, np.inf)]
        while arcs:
            a, b = arcs.pop()
            nu = b if np.isinf(b) else float(np.sqrt(a * b))
            _, (d,), (gain,) = self.at(nu)
            if gain > level:
                return nu
            ends = crossings(replace(s, B=s.B / d[w], C=s.C * d[z, None], D=s.D * d[z, None] / d[w]), level)
            low, high = ends[ends <= nu].max(initial=0.0), ends[ends > nu].min(initial=np.inf)
            arcs += [arc for arc in ((a, low), (high, b)) if arc[1] > arc[0] * (1 + ITERATED)]
        return None


@frozen
class StructuredPeak:
    """The largest mu: at most `upper`, at least `lower`, at which ``Delta / lower`` has the loop at its limit."""

    upper: float
    lower: float
    at_hz: float
    Delta: Array  # (w, z), complex, every block of norm one


def peak(blocks: Blocks, tolerance: float) -> StructuredPeak:
    """Return bounds of the largest mu; `tolerance` is the relative width of the search for the upper one."""
    nu = blocks.frequencies[np.argmax(blocks.at(blocks.frequencies)[2])]
    for _ in range(_STEPS):
        (M,), (d,), (gain,) = blocks.at(nu)
        level = max(gain * (1 + tolerance), TINY)
        above = blocks.exceeding(level)
        if above is None:
            return StructuredPeak(level, *attained(blocks, M, d, np.arctan(nu) / (np.pi * blocks.system.dt)))
        nu = above
    raise SynthesisError(f"Small gain: no level holds after {_STEPS} steps, the last was {level:.4g}; scale signals.")


def attained(blocks: Blocks, M: Array, d: Array, at_hz: float) -> tuple[float, float, Array]:
    """Return the largest ``rho(M Delta)`` that is found, its frequency, and Delta."""
    from scipy.linalg import eig

    w, z = blocks.places
    u, sigma, v = np.linalg.svd(M * d[z, None] / d[w], full_matrices=False)
    p, x, best = (sigma @ v).conj(), u @ sigma, (-1.0, at_hz, M.T)  # equal singular values take part alike
    for _ in range(_STEPS):
        pieces = [np.outer(np.where(w == i, p, 0), np.where(z == i, x, 0).conj()) for i in range(len(blocks.sizes))]
        delta = np.sum([piece / max(np.linalg.norm(piece), TINY) for piece in pieces], axis=0)
        values, left, right = eig(M @ delta, left=True)
        k = int(np.argmax(np.abs(values)))
        size = float(np.abs(values[k]))
        best = max(best, (size, at_hz, delta * values[k].conj() / max(size, TINY)), key=lambda found: found[0])
        p, x = M.conj().T @ left[:, k], right[:, k]
    return best


def worst_gain(blocks: Blocks, tolerance: float) -> float:
    """Return a proven bound of the gain of the last channel, for all perturbations of the other blocks up to norm one.

    Infinity where none is found.
    """
    system, performance = blocks.system, blocks.places[1] == len(blocks.sizes) - 1

    def proven(level: float) -> bool:
        size = np.where(performance, level, 1.0)[:, None]
        return Blocks(replace(system, C=system.C / size, D=system.D / size), blocks.sizes).exceeding(1.0) is None

    low = max(float(np.linalg.norm(blocks.at(blocks.frequencies)[0][:, performance], 2, (1, 2)).max()), TINY)
    high = next((high for high in low * 2.0 ** np.arange(1, _STEPS) if proven(high)), np.inf)
    while low * (1 + tolerance) < high < np.inf:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if proven(middle) else (middle, high)
    return float(high)
