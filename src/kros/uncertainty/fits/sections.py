r"""Magnitudes as products of sections of first and second order, in coordinates in which every step is a stable, minimum-phase system.

With `w = (z - 1) / (z + 1)` and `tau = -w^2` on the unit circle, a pair of zeros or poles is `w^2 + b w + c` with b, c > 0, real or complex,
and a single one `w + a`:

    |w^2 + b w + c|^2 / c^2 = (1 + u)^2 (1 + (e^y - 4) v),   u = tau / c,  v = u / (1 + u)^2,  x = log c,  y = log(b^2 / c)
    |w + a|^2 / a^2         = 1 + u,                         u = tau / a^2,  x = log a^2

A resonance moves by its x and widens by its y, where as coefficients of a polynomial all of them would have to move. Nothing has to be kept
positive, no roots are sought, and sums of logarithms do not cancel over any number of decades.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import KrosError
from ...core.lti import StateSpace
from .spectral import RationalMagnitude, cascade, roots

Array = npt.NDArray[Any]

_FAR = 1e30  # tau at Nyquist
_NARROW, _WIDE = np.log(4 * 3e-3**2), 40.0  # y: damping of 0.003, and two real ones 17 decades apart
_TINY = 1e-300
_REAL = 1e-9  # relative imaginary part below which a root counts as real


@dataclass(frozen=True, eq=False)
class Sections:
    """Magnitudes, one for every entry of a weight."""

    level: Array  # (entry,), nepers: log magnitude at DC
    entry: Array  # (section,): the entry a section belongs to
    sign: Array  # (section,): 1 for zeros, -1 for poles
    pair: Array  # (section,): whether it is of second order
    corner: Array  # (section,): x
    width: Array  # (section,): y; of no effect in sections of first order

    @classmethod
    def spread(cls, corners: Sequence[Array], orders: Sequence[int], width: float) -> Sections:
        """Return magnitudes of one: poles and, on top of them, zeros at every corner of an entry, two of each; one at the last corner of an odd order."""
        rows = [
            (entry, sign, 2 * (i + 1) <= order, x)
            for entry, (values, order) in enumerate(zip(corners, orders, strict=True))
            for i, x in enumerate(values)
            for sign in (1.0, -1.0)
        ]
        entry, sign, pair, corner = (
            (np.array(column) for column in zip(*rows, strict=True)) if rows else (np.zeros(0),) * 4
        )
        return cls(
            np.zeros(len(corners)),
            entry.astype(int),
            sign,
            pair.astype(bool),
            corner.astype(float),
            np.full(len(rows), width),
        )

    def like(self, entries: Array, magnitude: RationalMagnitude) -> Sections:
        """Return the same with poles, zeros and level of a magnitude in some entries."""
        others, level = ~np.isin(self.entry, entries), self.level.copy()
        sides = [roots(c, magnitude.knots)[0] for c in (magnitude.numerator, magnitude.denominator)]
        if any(len(side) < len(magnitude.knots) or 0 in side for side in sides):
            raise KrosError("Weight sections: the magnitude is zero or infinite at DC or Nyquist; try another order.")
        level[entries] = np.log(magnitude.numerator[0] / magnitude.denominator[0]) / 2
        columns = [[getattr(self, x)[others]] for x in ("entry", "sign", "pair", "corner", "width")]
        for sign, side in zip((1.0, -1.0), sides, strict=True):
            for pair, corner, width in _paired([np.sqrt(-complex(t)) for t in side]):
                for column, value in zip(columns, (entries, sign, pair, corner, width), strict=True):
                    column.append(np.broadcast_to(np.asarray(value), len(entries)))
        entry, sign_, pair_, corner_, width_ = (np.concatenate(column) for column in columns)
        return Sections(level, entry, sign_, pair_, corner_, width_)

    @property
    def orders(self) -> Array:
        """Order of every entry."""
        poles = self.sign < 0
        return np.bincount(self.entry[poles], np.where(self.pair[poles], 2, 1), minlength=len(self.level)).astype(int)

    @property
    def owner(self) -> Array:
        """Entry of every parameter: levels, corners, widths of pairs."""
        return np.concatenate([np.arange(len(self.level)), self.entry, self.entry[self.pair]])

    def logs(self, tau: Array) -> Array:
        """Return log magnitudes, nepers, shape (entry, frequency)."""
        u, q = self._variables(tau)
        value = np.where(self.pair[:, None], np.log(q) + 2 * np.log1p(u), np.log1p(u)) * (self.sign / 2)[:, None]
        return self.level[:, None] + self._sum(value)

    def slopes(self, tau: Array) -> Array:
        """Return derivatives of the owner's log magnitude, shape (parameter, frequency)."""
        u, q = self._variables(tau)
        share, half = u / (1 + u), (self.sign / 2)[:, None]
        v, extra = share / (1 + u), np.exp(self.width)[:, None]
        by_corner = np.where(self.pair[:, None], (extra - 4) * v * (1 - 2 * share) / q + 2 * share, share)
        by_width = (extra * v / q)[self.pair]
        return np.vstack([np.ones((len(self.level), len(tau))), -half * by_corner, half[self.pair] * by_width])

    def curvature(self, tau: Array, weights: Array) -> Array:
        """Return the convex part of the second derivatives of a sum of log magnitudes with weights (entry, frequency), shape (parameter, parameter)."""
        u, q = self._variables(tau)
        s, extra = u / (1 + u), np.exp(self.width)[:, None]
        v = s / (1 + u)
        v_x, by_x, by_y = -v * (1 - 2 * s), -(extra - 4) * v * (1 - 2 * s) / q, extra * v / q
        second = np.array(
            [
                [(extra - 4) * (v * (1 - 2 * s) ** 2 - 2 * v**2) / q - by_x**2 + 2 * v, extra * v_x / q - by_y * by_x],
                [extra * v_x / q - by_y * by_x, by_y - by_y**2],
            ]
        )
        share = weights[self.entry] * (self.sign / 2)[:, None]
        blocks = np.einsum("abkf,kf->kab", second, share)
        blocks[~self.pair] = 0.0
        blocks[~self.pair, 0, 0] = (v * share).sum(axis=1)[~self.pair]
        values, vectors = np.linalg.eigh(blocks)
        blocks = np.einsum("kai,ki,kbi->kab", vectors, values.clip(0.0), vectors)
        n, k = len(self.level), len(self.entry)
        out, corner, width = np.zeros((len(self.owner),) * 2), n + np.arange(k), n + k + np.arange(int(self.pair.sum()))
        out[corner, corner] = blocks[:, 0, 0]
        out[width, width] = blocks[self.pair, 1, 1]
        out[corner[self.pair], width] = out[width, corner[self.pair]] = blocks[self.pair, 0, 1]
        return out

    def moved(self, step: Array, ends: tuple[float, float]) -> Sections:
        """Return sections with all parameters moved, corners kept within ends."""
        n, k = len(self.level), len(self.corner)
        width = self.width.copy()
        width[self.pair] = np.clip(width[self.pair] + step[n + k :], _NARROW, _WIDE)
        return replace(
            self, level=self.level + step[:n], corner=np.clip(self.corner + step[n : n + k], *ends), width=width
        )

    def lifted(self, entries: slice, by: float) -> Sections:
        """Return sections with the levels of some entries raised."""
        level = self.level.copy()
        level[entries] += by
        return replace(self, level=level)

    def bends(self) -> Array:
        """Return the tau at which sections bend: a peak or a notch between grid points is there."""
        return np.unique(np.exp(self.corner))

    def systems(self, sample_period_s: float) -> list[StateSpace]:
        """Return the systems of the entries."""
        return [self._system(i, sample_period_s) for i in range(len(self.level))]

    def _system(self, entry: int, sample_period_s: float) -> StateSpace:
        zeros, poles = self._roots(entry, 1.0), self._roots(entry, -1.0)
        constant = np.where(self.pair, 1.0, 0.5) * self.corner * self.sign
        factor = self.level[entry] - constant[self.entry == entry].sum()
        return cascade(zeros, poles, float(np.exp(factor)), sample_period_s)

    def _roots(self, entry: int, sign: float) -> list[complex]:
        """Return roots in w: the larger real one of a pair without cancellation, the other from their product."""
        found: list[complex] = []
        for k in np.flatnonzero((self.entry == entry) & (self.sign == sign)):
            size = np.exp(self.corner[k] / 2)
            if not self.pair[k]:
                found.append(complex(-size))
                continue
            half = np.exp(self.width[k] / 2) / 2
            if half < 1:
                root = size * complex(-half, np.sqrt((1 - half) * (1 + half)))
                found += [root, root.conjugate()]
            else:
                large = half + np.sqrt((half - 1) * (half + 1))
                found += [complex(-size * large), complex(-size / large)]
        return found

    def _variables(self, tau: Array) -> tuple[Array, Array]:
        u = np.minimum(tau, _FAR) * np.exp(-self.corner)[:, None]
        return u, np.maximum(1 + (np.exp(self.width)[:, None] - 4) * u / (1 + u) ** 2, _TINY)

    def _sum(self, values: Array) -> Array:
        """Sum over the sections of every entry."""
        member = np.zeros((len(self.level), len(self.entry)))
        member[self.entry, np.arange(len(self.entry))] = 1.0
        return member @ values

    def with_pairs(self, entries: Array, corners: Array, width: float) -> Sections:
        """Return the same magnitudes, with a pair of zeros and one of poles on top of each other in some entries."""
        twice = np.repeat(np.arange(len(entries)), 2)
        return Sections(
            self.level,
            np.concatenate([self.entry, np.asarray(entries)[twice]]),
            np.concatenate([self.sign, np.tile([1.0, -1.0], len(entries))]),
            np.concatenate([self.pair, np.ones(len(twice), bool)]),
            np.concatenate([self.corner, np.asarray(corners)[twice]]),
            np.concatenate([self.width, np.full(len(twice), width)]),
        )

    def idlest(self, entry: int, tau: Array) -> Idle | None:
        """Return the poles and zeros of an entry that cancel each other best, none where there are none of the same order."""
        own = np.flatnonzero(self.entry == entry)
        zeros, poles = own[self.sign[own] > 0], own[self.sign[own] < 0]
        alone = replace(self, level=np.zeros(len(self.entry)), entry=np.arange(len(self.entry))).logs(tau)
        both = alone[zeros][:, None] + alone[poles]
        span = np.where(self.pair[zeros][:, None] == self.pair[poles], np.ptp(both, axis=2), np.inf)
        if not np.isfinite(span).any():
            return None
        i, j = np.unravel_index(int(span.argmin()), span.shape)
        return Idle(
            entry, int(zeros[i]), int(poles[j]), float(span[i, j]), float(both[i, j].max() + both[i, j].min()) / 2
        )

    def without(self, idle: Idle) -> Sections:
        """Return the magnitudes without poles and zeros that cancel each other."""
        kept = np.setdiff1d(np.arange(len(self.entry)), [idle.zero, idle.pole])
        level = self.level.copy()
        level[idle.entry] += idle.middle
        return Sections(level, self.entry[kept], self.sign[kept], self.pair[kept], self.corner[kept], self.width[kept])

    def halved(self, idle: Idle) -> Sections:
        """Return the magnitudes with one pole and one zero instead of two that cancel each other."""
        pair = self.pair.copy()
        pair[[idle.zero, idle.pole]] = False
        return replace(self, pair=pair)


@dataclass(frozen=True)
class Idle:
    """A zero and a pole section that nearly cancel: their indices, and range and middle of the log magnitude of both, nepers."""

    entry: int
    zero: int
    pole: int
    span: float
    middle: float


def _paired(found: list[complex]) -> list[tuple[bool, float, float]]:
    """Return sections of roots, negated: complex pairs, real ones with their neighbours, and the middle one alone where their number is odd."""
    real = sorted(r.real for r in found if abs(r.imag) <= _REAL * abs(r))
    rows = [
        (True, 2 * np.log(abs(r)), np.log(4 * (r.real / abs(r)) ** 2 + _TINY)) for r in found if r.imag > _REAL * abs(r)
    ]
    if len(real) % 2:
        rows.append((False, 2 * np.log(real.pop(len(real) // 2)), 0.0))
    return rows + [
        (True, np.log(a * b), np.log((a + b) ** 2 / (a * b))) for a, b in zip(real[::2], real[1::2], strict=True)
    ]
