r"""Joint fit of all magnitudes of a diagonal weight, tight against the cost of the optimal cover.

The parameters of all entries (`sections`) are moved together, to minimise

    max_f ( mean_i log W_L,i + mean_j log W_R,j - optimal(f) )  +  max_(f, k) log sigma_max(W_L^-1 E_k W_R^-1)

where the second term is what soundness at all frequencies costs in scale. No single cover has to be followed: whole
families are within a fraction of a decibel of the optimum. Square weights pay a share of their peak, the largest
`W_L,i W_R,i`, besides: a large one brings an inverse form close to an ill-posed set.

Every maximum is smoothed, `T log sum exp(. / T)`, with a temperature T that falls as the fit settles; steps are those
of Gauss and Newton, damped, with the spread of the gradients, `(sum w g g^T - (sum w g)(sum w g)^T) / T`. Singular
values move along their vectors, `d log sigma = -sum |u_i|^2 d log W_L,i - sum |v_j|^2 d log W_R,j`.

The start are the best fits of every entry of a smooth cover (`magnitude`). From the local optimum that it leads to,
poles and zeros are added where the fit gains most and the weakest taken out again, as long as that gains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..settings import FitSettings
from .cover import optimal_cover
from .magnitude import best_sections
from .sections import Sections

Array = npt.NDArray[Any]

NEPER_DB = 20 / np.log(10.0)
_FARTHEST = 1.5  # nepers: largest change of a parameter in a step
_NEGLIGIBLE = 1e-4  # weight of a term in a smoothed maximum
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class JointProblem:
    """Residuals of units at frequencies, and the cost that is to be met there."""

    tau: Array  # (frequency,)
    optimal: Array  # (frequency,), nepers: mean log left plus mean log right; infinite where nothing has to be tight
    residuals: Array  # (n, p', m'), complex
    at: Array  # (n,): the frequency of each

    @classmethod
    def of(cls, tau: Array, optimal: Array, E: Array) -> JointProblem:
        """Return the problem of residuals (unit, frequency, p', m')."""
        at = np.tile(np.arange(len(tau)), len(E))
        return cls(tau, optimal, E.reshape(-1, *E.shape[2:]), at)

    def joined(self, other: JointProblem) -> JointProblem:
        """Return both."""
        tau, optimal = np.append(self.tau, other.tau), np.append(self.optimal, other.optimal)
        residuals = np.concatenate([self.residuals, other.residuals])
        return JointProblem(tau, optimal, residuals, np.append(self.at, other.at + len(self.tau)))

    @property
    def shape(self) -> tuple[int, int]:
        """Left and right entries."""
        return int(self.residuals.shape[1]), int(self.residuals.shape[2])

    @cached_property
    def ends(self) -> tuple[float, float]:
        """Logs of the least and the largest tau between DC and Nyquist."""
        inner = np.log(self.tau[(self.tau > 0) & (self.tau < np.finfo(float).max)])
        return (float(inner.min()), float(inner.max())) if inner.size else (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class JointFit:
    """Sections that are sound for a problem, and the largest excess of their cost, dB."""

    sections: Sections
    excess_db: float


def fit_jointly(problem: JointProblem, max_order: int, tolerance_db: float, settings: FitSettings) -> JointFit:
    """Return diagonal magnitudes, left ones first, within the tolerance at lower orders."""
    search = _Search(problem, settings)
    fitted = search.descended(_start(problem, max_order, settings), tolerance_db)
    fitted = search.exchanged(fitted, tolerance_db)
    return search.lowered(fitted, tolerance_db) if fitted.excess_db <= tolerance_db else fitted


def refit(problem: JointProblem, sections: Sections, settings: FitSettings) -> JointFit:
    """Return the fit from sections that are close already."""
    return _Search(problem, settings).descended(sections)


def _start(problem: JointProblem, order: int, settings: FitSettings) -> Sections:
    """Return the best fits of the order to every entry of a smooth cover, one of whose right entries is one."""
    E = problem.residuals.reshape(-1, len(problem.tau), *problem.shape)
    inside = np.flatnonzero(np.isfinite(problem.optimal))
    cover = optimal_cover(E[:, inside], pull=settings.pull)
    near = np.searchsorted((inside[1:] + inside[:-1]) / 2, np.arange(len(problem.tau)))
    sides = np.hstack([cover.left, cover.right])[near].T
    return Sections.stacked([best_sections(problem.tau, values, order) for values in sides])


def _wider(problem: JointProblem) -> tuple[float, float]:
    """Return the ends that corners may take, three decades of tau beyond those of the problem."""
    decades = np.log(10.0) * 3
    return problem.ends[0] - decades, problem.ends[1] + decades


@dataclass(frozen=True, eq=False)
class _Search:
    """Moves between local optima of one problem."""

    problem: JointProblem
    settings: FitSettings

    def descended(self, start: Sections, enough_db: float = -np.inf) -> JointFit:
        """Return better sections of the same orders, raised to be sound."""
        state, damping = _State.of(self.problem, start, self.settings.peak_price), 1e-2
        for temperature in self.settings.temperatures:
            for _ in range(self.settings.steps):
                if state.excess_db <= self.settings.enough * enough_db:
                    return state.fitted()
                before = state.value(temperature)
                state, damping = state.step(temperature, damping)
                if before - state.value(temperature) < self.settings.settled * temperature:
                    break
        return state.fitted()

    def exchanged(self, fitted: JointFit, tolerance_db: float) -> JointFit:
        """Add poles and zeros where the fit gains most, take the weakest out."""
        for _ in range(self.settings.exchanges):
            if fitted.excess_db <= tolerance_db:
                break
            sections = self.descended(self._grown(fitted.sections)).sections
            for entry in np.flatnonzero(sections.orders > 0):
                while sections.orders[entry] > fitted.sections.orders[entry]:
                    dipole = sections.weakest(int(entry), self.problem.tau)
                    if dipole is None:
                        return fitted
                    much = sections.orders[entry] - fitted.sections.orders[entry] > 1
                    whole = much or not sections.pair[dipole.zero]
                    sections = sections.without(dipole) if whole else sections.halved(dipole)
            other = self.descended(sections)
            if not other.excess_db < fitted.excess_db:
                break
            stalled = other.excess_db > self.settings.stalled * fitted.excess_db
            fitted = other
            if stalled:
                break
        return fitted

    def _grown(self, start: Sections) -> Sections:
        """Return the same magnitudes with a pair of poles and zeros more in every entry."""
        entries, count = np.flatnonzero(start.orders > 0), self.settings.corners
        corners, width = np.linspace(*self.problem.ends, count), np.log(2.0)
        probe = Sections.spread([corners[[i]] for i in range(count)], [2] * count, width)
        slopes = probe.slopes(self.problem.tau)[count:]
        weights = _State.of(self.problem, start, self.settings.peak_price).weights(self.settings.temperatures[1])
        apart = slopes[: 2 * count : 2], slopes[2 * count :: 2]  # of the zeros: by corner and by width
        gains = sum(np.abs(weights[entries] @ s.T) / np.linalg.norm(s, axis=1) for s in apart)
        return start.with_pairs(entries, corners[np.argmax(gains, axis=1)], width)

    def lowered(self, fitted: JointFit, tolerance_db: float) -> JointFit:
        """Take out poles and zeros that cancel, the weakest first, as long as the tolerance holds."""
        pending = set(np.flatnonzero(fitted.sections.orders > 0).tolist())
        while pending:
            pairs = [fitted.sections.weakest(entry, self.problem.tau) for entry in pending]
            dipole = min((d for d in pairs if d is not None), key=lambda d: d.span, default=None)
            if dipole is None or dipole.span * NEPER_DB > self.settings.weak_db:
                break
            sections = fitted.sections
            fewer = [sections.without(dipole)] + [sections.halved(dipole)] * bool(sections.pair[dipole.zero])
            lower = (self.descended(s, tolerance_db) for s in fewer)
            accepted = next((f for f in lower if f.excess_db <= tolerance_db), None)
            if accepted is None:
                pending.discard(dipole.entry)
            fitted = accepted or fitted
        return fitted


@dataclass(frozen=True, eq=False)
class _Terms:
    """Terms under one smoothed maximum: values, frequencies, and how much every entry moves each."""

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
        """Return gradient and Gauss-Newton Hessian."""
        weight = self.weights(temperature)
        some = np.flatnonzero(weight > _NEGLIGIBLE)
        rows = self.shares[some][:, owner].T * slopes[:, self.at[some]]
        scaled = rows * weight[some]
        gradient = scaled.sum(axis=1)
        return self.price * gradient, self.price / temperature * (scaled @ rows.T - np.outer(gradient, gradient))


@dataclass(frozen=True, eq=False)
class _State:
    """Sections, and what they give at every frequency."""

    problem: JointProblem
    sections: Sections
    terms: tuple[_Terms, ...]  # cost, soundness, and the peak of square weights

    @classmethod
    def of(cls, problem: JointProblem, sections: Sections, price: float) -> _State:
        logs, (p, m) = sections.logs(problem.tau), problem.shape
        left, right = logs[:p], logs[p:]
        sigma, shares = _singular(
            problem.residuals * np.exp(-left.T[problem.at][:, :, None] - right.T[problem.at][:, None])
        )
        excess = left.mean(axis=0) + right.mean(axis=0) - problem.optimal
        inside = np.flatnonzero(np.isfinite(excess))
        mean = np.broadcast_to(np.repeat([1 / p, 1 / m], [p, m]), (len(inside), p + m))
        peak = price if p == m else 0.0
        sound = _Terms(sigma.ravel(), np.repeat(problem.at, sigma.shape[1]), -shares.reshape(-1, p + m), 1.0 + peak)
        terms = _Terms(excess[inside], inside, mean, 1.0), sound
        if not peak:
            return cls(problem, sections, terms)
        both, count = np.tile(np.eye(p), 2), len(problem.tau)
        product = _Terms((left + right).ravel(), np.tile(np.arange(count), p), np.repeat(both, count, axis=0), peak)
        return cls(problem, sections, (*terms, product))

    @cached_property
    def _values(self) -> dict[float, float]:
        return {}

    def value(self, temperature: float) -> float:
        """Return what is minimised, nepers."""
        if temperature not in self._values:
            self._values[temperature] = sum(t.smoothed(temperature) for t in self.terms)
        return self._values[temperature]

    def weights(self, temperature: float) -> Array:
        """Return how much every log magnitude moves what is minimised, shape (entry, frequency)."""
        out = np.zeros((len(self.problem.tau), len(self.sections.level)))
        for terms in self.terms:
            np.add.at(out, terms.at, terms.price * terms.weights(temperature)[:, None] * terms.shares)
        return out.T

    def step(self, temperature: float, damping: float) -> tuple[_State, float]:
        """Return the state after one damped step, and the damping of the next."""
        slopes, owner = self.sections.slopes(self.problem.tau), self.sections.owner
        parts = [t.derivatives(temperature, slopes, owner) for t in self.terms]
        gradient, hessian = sum(p[0] for p in parts), sum(p[1] for p in parts)
        size = np.diag(hessian)
        size = np.maximum(size, 1e-3 * size.max() + _TINY)
        before, ends = self.value(temperature), _wider(self.problem)
        price = self.terms[-1].price if len(self.terms) > 2 else 0.0
        for _ in range(8):
            move = -np.linalg.solve(hessian + np.diag(damping * size + 1e-12 * size.max()), gradient)
            move *= min(1.0, _FARTHEST / max(float(np.abs(move).max()), _TINY))
            trial = _State.of(self.problem, self.sections.moved(move, ends), price)
            if trial.value(temperature) < before:
                return trial, max(damping / 4, 1e-6)
            damping *= 4
        return self, damping

    @cached_property
    def excess_db(self) -> float:
        """Largest excess cost once raised to be sound."""
        return (float(self.terms[0].values.max()) + self._deficit) * NEPER_DB

    @property
    def _deficit(self) -> float:
        return float(self.terms[1].values.max())

    def fitted(self) -> JointFit:
        """Return the sections, raised to be sound."""
        return JointFit(self.sections.lifted(slice(0, self.problem.shape[0]), self._deficit), self.excess_db)


def _singular(matrices: Array) -> tuple[Array, Array]:
    """Return log singular values, (n, rank), and squared moduli of the entries of their vectors, left then right."""
    adjoint = np.conj(np.swapaxes(matrices, 1, 2))
    wide = matrices.shape[1] <= matrices.shape[2]
    squared, short = np.linalg.eigh(matrices @ adjoint if wide else adjoint @ matrices)
    long = np.abs((adjoint if wide else matrices) @ short) ** 2
    long /= np.maximum(long.sum(axis=1, keepdims=True), _TINY)
    parts: Sequence[Array] = (np.abs(short) ** 2, long) if wide else (long, np.abs(short) ** 2)
    return np.log(np.maximum(squared, _TINY)) / 2, np.swapaxes(np.concatenate(parts, axis=1), 1, 2)
