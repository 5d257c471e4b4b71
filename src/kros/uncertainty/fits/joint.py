r"""Joint fit: all magnitudes of a diagonal weight at once, tight against the cost of the optimal cover and not against one of its choices.

A cover has more freedom than its cost shows: whole families of covers are within a fraction of a decibel of the optimum, and units that take
turns put kinks in each. Fitting one cover entry by entry follows kinks that nobody needs. Here the parameters of all entries (`sections`) are
moved together, to minimise

    max_f ( mean_i log W_L,i + mean_j log W_R,j - optimal(f) )  +  max_(f, k) log sigma_max(W_L^-1 E_k W_R^-1)

where the second term is what soundness at all frequencies costs in scale. Square weights pay a twentieth of their peak, the largest
`W_L,i W_R,i`, besides: it decides among covers of equal cost, and a large one brings an inverse form close to an ill-posed set.

Every maximum is smoothed, `T log sum exp(. / T)`, with a temperature T that falls as the fit settles. Its Hessian is dominated by the spread
of the gradients of what is nearly worst, `(sum w g g^T - (sum w g)(sum w g)^T) / T`, so that damped Gauss-Newton steps suffice, where linear
programs over single maxima zigzag. Singular values move along their vectors,
`d log sigma = -sum |u_i|^2 d log W_L,i - sum |v_j|^2 d log W_R,j`. Every iterate is a sound weight after scaling by what it exceeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from .sections import Sections

Array = npt.NDArray[Any]

NEPER_DB = 20 * np.log10(np.e)
_PEAK = 0.05  # price of the peak
_FARTHEST = 1.5  # largest change of a parameter in a step
_SETTLED = 0.02  # gain of a step, in temperatures, below which the temperature falls
_TRIES = 8
_NEGLIGIBLE = 1e-6  # weight of a term in a smoothed maximum
_BEYOND = 7.0  # log tau that corners may go beyond the frequencies
_DAMPING = (1e-6, 1e-2)  # smallest and first
_CORNERS, _DIPOLE = 60, np.log(2.0)  # where further sections are tried, and their width
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class JointFit:
    """Data of a joint fit."""

    residuals: Array  # (n, p', m'), complex: of units at frequencies
    at: Array  # (n,): the frequency each belongs to
    tau: Array  # (frequency,)
    # (frequency,), nepers: cost of the optimal cover, mean log left plus mean log right; infinite where nothing has to be tight
    optimal: Array
    price: float = _PEAK  # of the peak of square weights

    @property
    def n_left(self) -> int:
        """Number of left entries."""
        return int(self.residuals.shape[1])

    def descend(self, start: Sections, temperatures: Sequence[float], steps: int, enough_db: float = -np.inf) -> Fitted:
        """Return better sections of the same orders, raised to be sound at the frequencies of the fit."""
        state, damping = _State.of(self, start), _DAMPING[1]
        for temperature in temperatures:
            for _ in range(steps):
                if state.excess_db <= enough_db:
                    return state.fitted()
                before = state.value(temperature)
                state, damping = state.step(temperature, damping)
                if before - state.value(temperature) < _SETTLED * temperature:
                    break
        return state.fitted()

    def ends(self) -> tuple[float, float]:
        """Corners that sections may take."""
        inner = np.log(self.tau[(self.tau > 0) & (self.tau < 1e12)])
        low, high = (inner.min(), inner.max()) if inner.size else (0.0, 0.0)  # DC and Nyquist alone
        return float(low - _BEYOND), float(high + _BEYOND)

    def evaluate(self, start: Sections) -> Fitted:
        """Return sections raised to be sound."""
        return _State.of(self, start).fitted()

    def grown(self, start: Sections, temperature: float) -> Sections:
        """Return the same magnitudes with a pair of poles and zeros more in every entry that has any, where moving them apart gains most."""
        low, high = self.ends()
        entries, corners = np.flatnonzero(start.orders > 0), np.linspace(low + _BEYOND, high - _BEYOND, _CORNERS)
        probe = Sections.spread([corners[[i]] for i in range(_CORNERS)], [2] * _CORNERS, _DIPOLE)
        slopes = probe.slopes(self.tau)[_CORNERS:]
        apart = slopes[: 2 * _CORNERS : 2], slopes[2 * _CORNERS :: 2]  # of the zeros: by corner and by width
        weights = _State.of(self, start).weights(temperature)[entries]
        gain = sum(np.abs(weights @ s.T) / np.linalg.norm(s, axis=1) for s in apart)
        return start.with_pairs(entries, corners[np.argmax(gain, axis=1)], _DIPOLE)


@dataclass(frozen=True, eq=False)
class Fitted:
    """Sections that are sound at the frequencies of a fit."""

    sections: Sections
    excess_db: float  # dB: largest excess cost


@dataclass(frozen=True, eq=False)
class _Terms:
    """One kind of terms under a smoothed maximum: values, frequencies, and how much every entry moves each."""

    values: Array  # (n,)
    at: Array  # (n,)
    shares: Array  # (n, entry)
    price: float

    def weights(self, temperature: float) -> Array:
        weight = np.exp((self.values - self.values.max()) / temperature)
        return np.asarray(weight / weight.sum())

    def smoothed(self, temperature: float) -> float:
        top = float(self.values.max())
        return self.price * (top + temperature * float(np.log(np.exp((self.values - top) / temperature).sum())))

    def derivatives(self, temperature: float, slopes: Array, owner: Array) -> tuple[Array, Array]:
        """Gradient and Gauss-Newton Hessian."""
        weight = self.weights(temperature)
        some = np.flatnonzero(weight > _NEGLIGIBLE)
        rows = self.shares[some][:, owner].T * slopes[:, self.at[some]]
        scaled = rows * weight[some]
        gradient = scaled.sum(axis=1)
        return self.price * gradient, self.price / temperature * (scaled @ rows.T - np.outer(gradient, gradient))


@dataclass(frozen=True, eq=False)
class _State:
    """Sections, and what they give at every frequency."""

    data: JointFit
    sections: Sections
    excess: Array  # (frequency,)
    sigma: Array  # log singular values, (n, rank)
    shares: Array  # squared moduli of the entries of the singular vectors, left then right, (n, rank, entry)
    product: Array  # log of left_i right_i, (entry, frequency), none for weights that are not square

    @classmethod
    def of(cls, data: JointFit, sections: Sections) -> _State:
        logs, p = sections.logs(data.tau), data.n_left
        left, right = logs[:p], logs[p:]
        scaled = data.residuals * np.exp(-left.T)[data.at][:, :, None] * np.exp(-right.T)[data.at][:, None, :]
        excess = left.mean(axis=0) + right.mean(axis=0) - data.optimal
        return cls(data, sections, excess, *_singular(scaled), left + right if len(left) == len(right) else left[:0])

    @cached_property
    def terms(self) -> tuple[_Terms, ...]:
        """What is smoothed: cost, soundness, and the peak of square weights."""
        p, price = self.data.n_left, self.data.price if self.product.size else 0.0
        m = len(self.sections.level) - p
        inside = np.flatnonzero(np.isfinite(self.excess))
        mean = np.concatenate([np.full(p, 1 / p), np.full(m, 1 / m)])
        n, rank = self.sigma.shape
        found = (
            _Terms(self.excess[inside], inside, np.broadcast_to(mean, (len(inside), p + m)), 1.0),
            _Terms(self.sigma.ravel(), np.repeat(self.data.at, rank), -self.shares.reshape(n * rank, -1), 1.0 + price),
        )
        if not price:
            return found
        both, count = np.tile(np.eye(p), 2), self.product.shape[1]
        return *found, _Terms(self.product.ravel(), np.tile(np.arange(count), p), np.repeat(both, count, axis=0), price)

    @cached_property
    def _values(self) -> dict[float, float]:
        return {}

    def value(self, temperature: float) -> float:
        """What is minimised, nepers."""
        if temperature not in self._values:
            self._values[temperature] = sum(t.smoothed(temperature) for t in self.terms)
        return self._values[temperature]

    def weights(self, temperature: float) -> Array:
        """How much every log magnitude moves what is minimised, shape (entry, frequency)."""
        out = np.zeros((len(self.data.tau), len(self.sections.level)))
        for terms in self.terms:
            np.add.at(out, terms.at, terms.price * terms.weights(temperature)[:, None] * terms.shares)
        return out.T

    def step(self, temperature: float, damping: float) -> tuple[_State, float]:
        """One damped Gauss-Newton step, and the damping of the next."""
        slopes, owner = self.sections.slopes(self.data.tau), self.sections.owner
        parts = [t.derivatives(temperature, slopes, owner) for t in self.terms]
        gradient, hessian = sum(p[0] for p in parts), sum(p[1] for p in parts)
        hessian = hessian + self.sections.curvature(self.data.tau, self.weights(temperature))
        size = np.diag(hessian)
        size = np.maximum(size, 1e-3 * size.max() + _TINY)
        before, ends = self.value(temperature), self.data.ends()
        for _ in range(_TRIES):
            move = -np.linalg.solve(hessian + np.diag(damping * size + 1e-12 * size.max()), gradient)
            move *= min(1.0, _FARTHEST / max(float(np.abs(move).max()), _TINY))
            trial = _State.of(self.data, self.sections.moved(move, ends))
            if trial.value(temperature) < before:
                return trial, max(damping / 4, _DAMPING[0])
            damping *= 4
        return self, damping

    @cached_property
    def excess_db(self) -> float:
        """Largest excess cost once raised to be sound."""
        return (float(self.excess[np.isfinite(self.excess)].max()) + float(self.sigma.max())) * NEPER_DB

    def fitted(self) -> Fitted:
        return Fitted(self.sections.lifted(slice(0, self.data.n_left), float(self.sigma.max())), self.excess_db)


def _singular(matrices: Array) -> tuple[Array, Array]:
    """Log singular values, shape (n, rank), and squared moduli of the entries of their vectors, shape (n, rank, p' + m'), from Gram matrices."""
    adjoint = np.conj(np.swapaxes(matrices, 1, 2))
    wide = matrices.shape[1] <= matrices.shape[2]
    squared, short = np.linalg.eigh(matrices @ adjoint if wide else adjoint @ matrices)
    long = np.abs((adjoint if wide else matrices) @ short) ** 2
    long /= np.maximum(long.sum(axis=1, keepdims=True), _TINY)
    parts = (np.abs(short) ** 2, long) if wide else (long, np.abs(short) ** 2)
    return np.log(np.maximum(squared, _TINY)) / 2, np.swapaxes(np.concatenate(parts, axis=1), 1, 2)


def follow(tau: Array, logs: Array, start: Sections, ends: tuple[float, float], steps: int) -> Sections:
    """Return sections that follow log magnitudes (entry, frequency) in the least-squares sense, by Levenberg and Marquardt's steps."""
    owner, damping = start.owner, 1e-2
    rest = logs - start.logs(tau)
    for _ in range(steps):
        slopes = start.slopes(tau)
        gradient = (slopes * rest[owner]).sum(axis=1)
        hessian = (slopes @ slopes.T) * (owner[:, None] == owner)
        move = np.linalg.solve(hessian + np.diag(damping * np.diag(hessian) + 1e-9 * len(tau)), gradient)
        trial = start.moved(np.clip(move, -_FARTHEST, _FARTHEST), ends)
        after = logs - trial.logs(tau)
        if (after**2).sum() < (rest**2).sum():
            start, rest, damping = trial, after, damping / 4
        else:
            damping *= 8
    return start
