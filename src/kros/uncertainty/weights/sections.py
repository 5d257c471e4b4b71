r"""Magnitudes as products of sections of first and second order, stable and minimum phase.

With `w = (z - 1) / (z + 1)` and `tau = -w^2` on the unit circle, a pair of zeros or poles is `w^2 + b w + c` with
b, c > 0, real or complex, and a single one is `w + a`:

    |w^2 + b w + c|^2 / c^2 = (1 + u)^2 (1 + (e^y - 4) v),   u = tau / c,  v = u / (1 + u)^2,
                                                               x = log c,  y = log(b^2 / c)
    |w + a|^2 / a^2         = 1 + u,                         u = tau / a^2,  x = log a^2

Sums of logarithms keep their precision over any number of decades. The systems are cascades of sections in
`zeta = z - 1`: poles next to `z = 1` keep their relative precision. With `w = zeta / (zeta + 2)`

    w^2 + b w + c  ~  zeta^2 + (2 b + 4 c) / (1 + b + c) zeta + 4 c / (1 + b + c),     w + a  ~  zeta + 2 a / (1 + a)

up to a factor and powers of zeta + 2, which cancel between zeros and poles; nothing else does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
    def of_roots(cls, level: float, zeros: AnyArray, poles: AnyArray) -> Sections:
        """Return the magnitude with equally many zeros and poles in w, and its log at DC."""
        sides = [(sign, *row) for sign, roots in ((1.0, zeros), (-1.0, poles)) for row in _paired(roots)]
        sign, pair, corner, width = np.array(sides).reshape(-1, 4).T
        return cls(np.array([level]), np.zeros(len(sides), int), sign, pair.astype(bool), corner, width)

    @classmethod
    def stacked(cls, parts: Sequence[Sections]) -> Sections:
        """Return the entries of several magnitudes."""
        entry = np.repeat(np.arange(len(parts)), [len(part.entry) for part in parts])
        names = ("level", "sign", "pair", "corner", "width")
        level, *rest = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
        return cls(level, entry, *rest)

    @property
    def orders(self) -> AnyArray:
        """Order of every entry."""
        poles = self.sign < 0
        return np.bincount(self.entry[poles], 1 + self.pair[poles], minlength=len(self.level)).astype(int)

    @property
    def owner(self) -> AnyArray:
        """Entry of every parameter."""
        return np.concatenate([np.arange(len(self.level)), self.entry, self.entry])

    @property
    def parameters(self) -> AnyArray:
        """Return levels, corners and widths."""
        return np.concatenate([self.level, self.corner, self.width])

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
        share, half, pair = u / (1 + u), (self.sign / 2)[:, None], self.pair[:, None]
        v, extra = share / (1 + u), np.exp(self.width)[:, None]
        by_corner = np.where(pair, (extra - 4) * v * (1 - 2 * share) / q + 2 * share, share)
        return np.vstack([np.ones((len(self.level), len(tau))), -half * by_corner, half * pair * extra * v / q])

    def at(self, parameters: AnyArray, ends: tuple[float, float]) -> Sections:
        """Return sections of other parameters, corners kept within ends."""
        level, corner, width = np.split(parameters, len(self.level) + len(self.corner) * np.arange(2))
        width = np.clip(width, np.log(4 * MAGNITUDE.damping**2), MAGNITUDE.widest)
        return replace(self, level=level, corner=np.clip(corner, *ends), width=width)

    def systems(self, sample_period_s: float) -> list[StateSpace]:
        """Return the systems of the entries, cascades with the poles beside the zeros next to them in size."""
        systems = []
        for entry, level in enumerate(self.level):
            system = gain([[np.exp(level)]], sample_period_s)
            for q, p in zip(self._polynomials(entry, 1.0), self._polynomials(entry, -1.0), strict=True):
                system = _section(q, p, sample_period_s) @ system
            systems.append(system)
        return systems

    def _polynomials(self, entry: int, sign: float) -> Iterator[AnyArray]:
        """Yield the coefficients in zeta of every section but the leading one, which is one, pairs first."""
        rows = np.flatnonzero((self.entry == entry) & (self.sign == sign))
        for k in rows[np.lexsort((self.corner[rows], ~self.pair[rows]))]:
            c, b, a = np.exp([self.corner[k], (self.corner[k] + self.width[k]) / 2, self.corner[k] / 2])
            yield np.array([4 * c, 2 * b + 4 * c]) / (1 + b + c) if self.pair[k] else np.array([2 * a / (1 + a)])

    def _variables(self, tau: AnyArray) -> tuple[AnyArray, AnyArray]:
        u = np.minimum(tau, np.cbrt(_FLOAT.max)) * np.exp(-self.corner)[:, None]
        return u, np.maximum(1 + (np.exp(self.width)[:, None] - 4) * u / (1 + u) ** 2, _FLOAT.tiny)


def _paired(roots: AnyArray) -> list[tuple[bool, float, float]]:
    """Return sections (pair, x, y) of roots: complex pairs, real ones with their neighbours."""
    upper, real = roots[roots.imag > 0], list(np.sort(roots.real[roots.imag == 0]))
    single = [real.pop(len(real) // 2)] if len(real) % 2 else []
    pairs = [*zip(upper, upper.conj(), strict=True), *zip(real[::2], real[1::2], strict=True)]
    rows = [(True, (a * b).real, (a + b).real ** 2 / (a * b).real + _FLOAT.tiny) for a, b in pairs]
    return [(pair, np.log(c), np.log(y)) for pair, c, y in [*rows, *((False, a**2, 1.0) for a in single)]]


def _section(q: AnyArray, p: AnyArray, dt: float) -> StateSpace:
    """Return the section of numerator and denominator in zeta, of first or second order, with a gain of one at DC."""
    kappa = np.sqrt(p[0])
    A = np.array([[1.0, kappa], [-kappa, 1 - p[1]]]) if len(p) == 2 else np.array([[1 - p[0]]])
    C = (q - p) / np.array([kappa, 1.0])[-len(p) :]
    size, factor = np.sqrt(max(float(np.abs(C).max()), _FLOAT.tiny)), p[0] / q[0]
    return StateSpace(A, size * np.eye(len(p))[:, -1:], factor * C[None] / size, np.array([[factor]]), dt)
