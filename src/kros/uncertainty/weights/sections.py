r"""Magnitudes as products of sections of first and second order, stable and minimum phase.

With `w = (z - 1) / (z + 1)` and `tau = -w^2` on the unit circle, a pair of zeros or poles is `w^2 + b w + c` with
b, c > 0, real or complex, and a single one is `w + a`:

    |w^2 + b w + c|^2 / c^2 = (1 + u)^2 (1 + (e^y - 4) v),   u = tau / c,  v = u / (1 + u)^2,
                                                               x = log c,  y = log(b^2 / c)
    |w + a|^2 / a^2         = 1 + u,                         u = tau / a^2,  x = log a^2

Sums of logarithms keep their precision over any number of decades. The systems are cascades of sections in
`zeta = z - 1`: poles next to `z = 1` keep their relative precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...core import ROUNDING, AnyArray, Array, ArrayLike, StateSpace, frozen, gain
from ..settings import MAGNITUDE

_FLOAT = np.finfo(float)


def bilinear_squared(freqs_hz: ArrayLike, sample_period_s: float) -> Array:
    """Return tau = tan^2(theta / 2); infinity at Nyquist, and full relative precision near DC."""
    freqs = np.asarray(freqs_hz, dtype=float)
    half = np.pi * freqs * sample_period_s
    at_top = np.abs(freqs * sample_period_s - 0.5) <= ROUNDING
    return np.where(at_top, np.inf, np.tan(np.where(at_top, 0.0, half)) ** 2)


@frozen
class Sections:
    """Magnitudes, one for every entry of a weight."""

    level: AnyArray  # (entry,), nepers: log magnitude at DC
    entry: AnyArray  # (section,): the entry that a section belongs to
    sign: AnyArray  # (section,): 1 for zeros, -1 for poles
    pair: AnyArray  # (section,): whether it is of second order
    corner: AnyArray  # (section,): x
    width: AnyArray  # (section,): y; of no effect in sections of first order

    @classmethod
    def of_roots(cls, level: float, zeros: Sequence[complex], poles: Sequence[complex]) -> Sections:
        """Return the magnitude with equally many zeros and poles in w, and its log at DC."""
        sides = [(sign, *row) for sign, roots in ((1.0, zeros), (-1.0, poles)) for row in _paired(roots)]
        sign, pair, corner, width = np.array(sides).reshape(-1, 4).T
        return cls(np.array([level]), np.zeros(len(sides), int), sign, pair.astype(bool), corner, width)

    @classmethod
    def stacked(cls, parts: Sequence[Sections]) -> Sections:
        """Return the entries of several, one after the other."""
        first = np.cumsum([0, *(len(part.level) for part in parts)])
        entry = np.concatenate([part.entry + n for part, n in zip(parts, first[:-1], strict=True)])
        names = ("sign", "pair", "corner", "width")
        rest = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
        return cls(np.concatenate([part.level for part in parts]), entry, *rest)

    @property
    def orders(self) -> AnyArray:
        """Order of every entry."""
        poles = self.sign < 0
        return np.bincount(self.entry[poles], 1 + self.pair[poles], minlength=len(self.level)).astype(int)

    @property
    def owner(self) -> AnyArray:
        """Entry of every parameter: levels, corners, widths of pairs."""
        return np.concatenate([np.arange(len(self.level)), self.entry, self.entry[self.pair]])

    @property
    def parameters(self) -> AnyArray:
        """Return levels, corners and widths of pairs."""
        return np.concatenate([self.level, self.corner, self.width[self.pair]])

    def logs(self, tau: AnyArray) -> AnyArray:
        """Return log magnitudes, nepers, shape (entry, frequency)."""
        total = np.repeat(self.level[:, None], len(tau), axis=1)
        u, q = self._variables(tau)
        logs = np.where(self.pair[:, None], np.log(q) + 2 * np.log1p(u), np.log1p(u))
        np.add.at(total, self.entry, logs * (self.sign / 2)[:, None])
        return total

    def slopes(self, tau: AnyArray) -> AnyArray:
        """Return derivatives of the owner's log magnitude, shape (parameter, frequency)."""
        u, q = self._variables(tau)
        share, half = u / (1 + u), (self.sign / 2)[:, None]
        v, extra = share / (1 + u), np.exp(self.width)[:, None]
        by_corner = np.where(self.pair[:, None], (extra - 4) * v * (1 - 2 * share) / q + 2 * share, share)
        by_width = (extra * v / q)[self.pair]
        return np.vstack([np.ones((len(self.level), len(tau))), -half * by_corner, half[self.pair] * by_width])

    def at(self, parameters: AnyArray, ends: tuple[float, float]) -> Sections:
        """Return sections of other parameters, corners kept within ends."""
        level, corner, pairs = np.split(parameters, [len(self.level), len(self.level) + len(self.corner)])
        width = self.width.copy()
        width[self.pair] = np.clip(pairs, np.log(4 * MAGNITUDE.damping**2), MAGNITUDE.widest)
        return replace(self, level=level, corner=np.clip(corner, *ends), width=width)

    def lifted(self, entries: slice, by: float) -> Sections:
        """Return sections with the levels of some entries raised."""
        level = self.level.copy()
        level[entries] += by
        return replace(self, level=level)

    def systems(self, sample_period_s: float) -> list[StateSpace]:
        """Return the systems of the entries."""
        return [self._system(i, sample_period_s) for i in range(len(self.level))]

    def _system(self, entry: int, dt: float) -> StateSpace:
        """Return `factor * prod (w - q) / prod (w - p)` as a cascade, poles beside the zeros next to them in size."""
        constant = (np.where(self.pair, 1.0, 0.5) * self.corner * self.sign)[self.entry == entry].sum()
        system = gain([[np.exp(self.level[entry] - constant)]], dt)
        for q, p in zip(self._roots(entry, 1.0), self._roots(entry, -1.0), strict=True):
            factor = float(np.real(np.prod(1 - q) / np.prod(1 - p)))
            system = _section(2 * q / (1 - q), 2 * p / (1 - p), factor, dt) @ system  # from w to zeta, nothing cancels
        return system

    def _roots(self, entry: int, sign: float) -> list[AnyArray]:
        """Return the roots in w of every section, pairs first."""
        rows = np.flatnonzero((self.entry == entry) & (self.sign == sign))
        roots = []
        for k in rows[np.lexsort((self.corner[rows], ~self.pair[rows]))]:
            size, half = np.exp(self.corner[k] / 2), np.exp(self.width[k] / 2) / 2
            apart = np.sqrt(complex((half - 1) * (half + 1)))
            large = half + apart
            roots.append(-size * np.array([large, 1 / large] if self.pair[k] else [1.0 + 0j]))
        return roots

    def _variables(self, tau: AnyArray) -> tuple[AnyArray, AnyArray]:
        u = np.minimum(tau, np.cbrt(_FLOAT.max)) * np.exp(-self.corner)[:, None]
        return u, np.maximum(1 + (np.exp(self.width)[:, None] - 4) * u / (1 + u) ** 2, _FLOAT.tiny)


def _paired(roots: Sequence[complex]) -> list[tuple[bool, float, float]]:
    """Return sections (pair, x, y) of roots: complex pairs, real ones with their neighbours."""
    real = sorted(-r.real for r in roots if abs(r.imag) <= np.sqrt(_FLOAT.eps) * abs(r))
    upper = [r for r in roots if r.imag > np.sqrt(_FLOAT.eps) * abs(r)]
    rows = [(True, 2 * np.log(abs(r)), np.log(4 * (r.real / abs(r)) ** 2 + _FLOAT.tiny)) for r in upper]
    if len(real) % 2:
        rows.append((False, 2 * np.log(real.pop(len(real) // 2)), 0.0))
    pairs = zip(real[::2], real[1::2], strict=True)
    return rows + [(True, np.log(a * b), np.log((a + b) ** 2 / (a * b))) for a, b in pairs]


def _section(q: AnyArray, p: AnyArray, factor: float, dt: float) -> StateSpace:
    """Section `factor (zeta - q) / (zeta - p)` of first or second order."""
    if len(p) == 1:
        step = float(np.real(p[0] - q[0]))
        size = np.sqrt(abs(step))
        A, B, C = np.array([[1 + p[0].real]]), np.array([[size]]), np.array([[np.copysign(size, step)]])
        return StateSpace(A, B, factor * C, np.array([[factor]]), dt)
    b1, b0 = np.real(p.sum() - q.sum()), np.real(q.prod() - p.prod())  # numerator minus denominator: b1 zeta + b0
    kappa, slow = np.sqrt(np.real(p.prod())), -p[0].real
    A = np.array([[1 - slow, kappa], [-(p[0].imag ** 2) / kappa, 1 + p[1].real]])
    C = np.array([[(b0 - b1 * slow) / kappa, b1]])
    size = np.sqrt(max(float(np.abs(C).max()), _FLOAT.tiny))
    return StateSpace(A, np.array([[0.0], [size]]), factor * C / size, np.array([[factor]]), dt)
