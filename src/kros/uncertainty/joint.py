r"""Joint fit: all magnitudes of a diagonal weight at once, tight against the cost of the optimal cover and not against one of its choices.

A cover has more freedom than its cost shows: whole families of covers are within a fraction of a decibel of the optimum, and units that take
turns put kinks in each. Fitting one cover entry by entry follows kinks that nobody needs. Here the coefficients of all entries are moved
together, to minimise

    max_f ( mean_i log W_L,i + mean_j log W_R,j - optimal(f) )  +  max_(f, k) log sigma_max(W_L^-1 E_k W_R^-1)

where the second term is what soundness at all frequencies costs in scale. Square weights pay a twentieth of their peak, the largest
`W_L,i W_R,i`, besides: it decides among covers of equal cost, and a large one brings an inverse form close to an ill-posed set. Sequential
linear programs: logarithms of the magnitudes are linearised in the coefficients of numerators and denominators, and log sigma along its
singular vectors, `d log sigma = -sum |u_i|^2 d log W_L,i - sum |v_j|^2 d log W_R,j`. A step is taken only where the true value falls, so that
every iterate is a sound weight after scaling and none is worse than the start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from .spectral import RationalMagnitude, basis

Array = npt.NDArray[Any]

_NEPER_DB = 20 * np.log10(np.e)
_STEPS = 40
_GUARDS = 3
_TRUST = 0.3  # largest first step of a coefficient, relative to where its numerator or denominator would turn negative
_WIDEST, _NARROWEST = 0.9, 1e-3
_GAIN_DB = 0.01  # a step that promises less is not taken
_PEAK = 0.05  # price of the peak
_DIRECTIONS = 3  # singular vectors per frequency that constrain a step


@dataclass(frozen=True, eq=False)
class JointFit:
    """Data of a joint fit.

    Parameters
    ----------
    residuals : ndarray, shape (unit, frequency, p', m'), complex
    tau : ndarray, shape (frequency,)
    optimal : ndarray, shape (frequency,), nepers
        Cost of the optimal cover: mean log left plus mean log right.
    guard : ndarray, shape (n,)
        Further tau at which numerators and denominators are kept positive.
    price : float
        Of the peak of square weights.
    """

    residuals: Array
    tau: Array
    optimal: Array
    guard: Array
    price: float = _PEAK

    def fit(self, start: Sequence[RationalMagnitude]) -> tuple[list[RationalMagnitude], float]:
        """Return squared magnitudes that are positive at all frequencies, and their excess cost in dB.

        Where the result of `improve` turns negative between the guarded points, its roots are guarded too; at last the start is taken.

        Parameters
        ----------
        start : sequence of RationalMagnitude, p' + m'
            Left ones first, positive at all frequencies.
        """
        guarded = self
        for _ in range(_GUARDS):
            found, excess = guarded.improve(start)
            bad = [x for r in found for x in r.negative_at()]
            if not bad:
                return found, excess
            guarded = replace(guarded, guard=np.concatenate([guarded.guard, bad, [np.sqrt(x * y) for x, y in pairwise(sorted(bad))]]))
        return guarded.improve(start, steps=0)

    def improve(self, start: Sequence[RationalMagnitude], steps: int = _STEPS) -> tuple[list[RationalMagnitude], float]:
        """Return better squared magnitudes, left ones first, of the same orders; scaled to be sound at `tau`, and their excess cost in dB."""
        every = np.concatenate([self.tau, self.guard])
        state = _State.of(self, [basis(every, r.knots) for r in start], [(r.numerator, r.denominator) for r in start])
        if state is None:
            return list(start), float("inf")
        trust = _TRUST
        for _ in range(steps):
            step = state.program(trust)
            if step is None or step.promise * _NEPER_DB < _GAIN_DB:
                break
            moved = _State.of(self, state.phi, step.pairs)
            gain = -np.inf if moved is None else state.value - moved.value
            if moved is not None and gain > 0:
                state = moved
            trust = min(_WIDEST, 1.6 * trust) if gain > 0.5 * step.promise else trust if gain > 0.2 * step.promise else trust / 3
            if trust < _NARROWEST:
                break
        lift = float(np.exp(2 * state.sigma.max()))
        n_left = self.residuals.shape[2]
        found = [
            RationalMagnitude(a * (lift if i < n_left else 1.0), b, r.knots)
            for i, ((a, b), r) in enumerate(zip(state.pairs, start, strict=True))
        ]
        return found, float(state.excess.max() + state.sigma.max()) * _NEPER_DB


@dataclass(frozen=True, eq=False)
class _Step:
    pairs: list[tuple[Array, Array]]
    promise: float


@dataclass(frozen=True, eq=False)
class _State:
    """Coefficients, and what they give at every frequency."""

    data: JointFit
    phi: list[Array]  # guard included
    pairs: list[tuple[Array, Array]]
    product: Array  # log of left_i right_i, (entry, frequency), none for weights that are not square
    excess: Array  # (frequency,)
    sigma: Array  # log singular values, (unit, frequency, rank)
    left: Array  # squared moduli of the entries of the singular vectors, (unit, frequency, p', rank)
    right: Array  # (unit, frequency, rank, m')

    @classmethod
    def of(cls, data: JointFit, phi: list[Array], pairs: list[tuple[Array, Array]]) -> _State | None:
        """Evaluate; None where a numerator or denominator is not positive."""
        logs, count = np.empty((len(pairs), len(data.tau))), len(data.tau)
        for i, (basis_i, (a, b)) in enumerate(zip(phi, pairs, strict=True)):
            n, d = basis_i @ a, basis_i @ b
            if min(n.min(), d.min()) <= 0:
                return None
            logs[i] = (np.log(n[:count]) - np.log(d[:count])) / 2
        p, m = data.residuals.shape[2:]
        M = data.residuals * np.exp(-logs[:p]).T[None, :, :, None] * np.exp(-logs[p:]).T[None, :, None, :]
        if not np.isfinite(M).all():
            return None
        u, s, v = np.linalg.svd(M, full_matrices=False)
        sigma = np.log(np.maximum(s, 1e-300))
        excess = logs[:p].mean(axis=0) + logs[p:].mean(axis=0) - data.optimal
        product = logs[:p] + logs[p:] if p == m else logs[:0]
        return cls(data, phi, pairs, product, excess, sigma, np.abs(u) ** 2, np.abs(v) ** 2)

    @property
    def value(self) -> float:
        """What is minimised, nepers."""
        scale = self.sigma.max()
        return float(self.excess.max() + scale + (self.data.price * (self.product.max() + scale) if self.product.size else 0.0))

    def program(self, trust: float) -> _Step | None:
        """Solve the linear program around this point."""
        from scipy.optimize import linprog

        reach, slopes, n_left = 4 * trust, self._slopes(), self.data.residuals.shape[2]
        near = np.flatnonzero(self.excess > self.excess.max() - reach)
        cost = slopes[:n_left, near].mean(axis=0) + slopes[n_left:, near].mean(axis=0)
        unit, freq, rank = self._binding(reach)
        sound = -np.einsum("ki,ikx->kx", self.left[unit, freq, :, rank], slopes[:n_left, freq])
        sound -= np.einsum("kj,jkx->kx", self.right[unit, freq, rank], slopes[n_left:, freq])
        entry, high = np.nonzero(self.product > self.product.max(initial=-np.inf) - reach)
        peak = slopes[entry, high] + slopes[n_left + entry, high]
        count, price = slopes.shape[-1], self.data.price if self.product.size else 0.0
        blocks = [np.hstack([rows, np.tile(-np.eye(3)[i], (len(rows), 1))]) for i, rows in enumerate((cost, sound, peak))]
        result = linprog(
            np.append(np.zeros(count), [1.0, 1.0 + price, price]),
            A_ub=np.vstack(blocks),
            b_ub=-np.concatenate([self.excess[near], self.sigma[unit, freq, rank], self.product[entry, high]]),
            bounds=[(-trust, trust)] * count + [(None, None)] * 2 + [(None, None) if price else (0.0, 0.0)],
            method="highs",
            options={"time_limit": 2.0, "presolve": False},
        )
        if result.x is None:
            return None
        moves = np.split(result.x[:count], np.cumsum([2 * p.shape[1] for p in self.phi])[:-1])
        pairs = []
        for (a, b), phi, move in zip(self.pairs, self.phi, moves, strict=True):
            up, down = _sizes(phi, a), _sizes(phi, b)
            pairs.append((a + move[: len(a)] * up, b + move[len(a) :] * down))
        return _Step(pairs, self.value - float(result.fun))

    def _slopes(self) -> Array:
        """Derivatives of the log magnitudes in the scaled coefficients, shape (entry, frequency, coefficient)."""
        widths = [2 * p.shape[1] for p in self.phi]
        ends = np.cumsum(widths)
        out = np.zeros((len(self.phi), len(self.data.tau), int(ends[-1])))
        for i, (phi, (a, b)) in enumerate(zip(self.phi, self.pairs, strict=True)):
            here = phi[: len(self.data.tau)]
            n, d = (here @ a)[:, None], (here @ b)[:, None]
            out[i, :, ends[i] - widths[i] : ends[i]] = np.hstack([here * _sizes(phi, a) / n, -here * _sizes(phi, b) / d]) / 2
        return out

    def _binding(self, reach: float) -> tuple[Array, Array, Array]:
        """Units, frequencies and ranks of the singular values within reach of the largest, the largest few of each frequency."""
        unit, freq, rank = np.nonzero(self.sigma > self.sigma.max() - min(reach, 0.7))
        order = np.lexsort((-self.sigma[unit, freq, rank], freq))
        unit, freq, rank = unit[order], freq[order], rank[order]
        first = np.arange(len(freq)) - np.searchsorted(freq, freq) < _DIRECTIONS
        return unit[first], freq[first], rank[first]


def _sizes(phi: Array, coefficients: Array) -> Array:
    """How far every coefficient may move alone before the sum turns negative somewhere."""
    return ((phi @ coefficients)[:, None] / np.maximum(phi, 1e-300)).min(axis=0)
