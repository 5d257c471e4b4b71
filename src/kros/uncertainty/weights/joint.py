r"""Joint fit of all magnitudes of a diagonal weight, tight against the cost of the optimal cover.

The parameters x of all entries (`sections`) are moved together, to minimise

    max_f ( mean_i log W_L,i + mean_j log W_R,j - optimal(f) )  +  max_(f, k) log sigma_max(W_L^-1 E_k W_R^-1)
    +  price * max_(f, i) log W_L,i W_R,i  +  pull / 2 |x - x_0|^2

The second term is what soundness at all frequencies costs in scale. Square weights pay a share of their peak: a large
one brings an inverse form close to an ill-posed set. The start x_0 are the best fits of the optimal cover, entry by
entry (`magnitude`). Whole families of weights are within a fraction of a decibel of the optimum; the last term makes it
unique, so that it follows the residuals continuously, and not their rounding.

Every maximum is smoothed, `T log sum exp(. / T)`, with a falling temperature T; steps are those of Gauss and Newton,
damped, with the spread of the gradients, `(sum w g g^T - (sum w g)(sum w g)^T) / T`. Singular values move along their
vectors, `d log sigma = -sum |u_i|^2 d log W_L,i - sum |v_j|^2 d log W_R,j`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from itertools import islice

import numpy as np

from ...core import TINY, AnyArray, frozen
from ...core.linalg import adjoint
from ..settings import FIT
from .cover import NEPER_DB, Cover
from .magnitude import Bound, rising_bounds
from .sections import Sections


@frozen
class JointProblem:
    """Residuals of units at frequencies, and the cost that is to be met there."""

    tau: AnyArray  # (frequency,)
    optimal: AnyArray  # (frequency,), nepers: mean log left plus mean log right; infinite where nothing has to be tight
    residuals: AnyArray  # (n, p', m'), complex
    at: AnyArray  # (n,): the frequency of each

    @classmethod
    def of(cls, tau: AnyArray, optimal: AnyArray, E: AnyArray) -> JointProblem:
        """Return the problem of residuals (unit, frequency, p', m')."""
        return cls(tau, optimal, E.reshape(-1, *E.shape[2:]), np.tile(np.arange(len(tau)), len(E)))

    def joined(self, other: JointProblem) -> JointProblem:
        """Return both."""
        tau, optimal = np.append(self.tau, other.tau), np.append(self.optimal, other.optimal)
        residuals = np.concatenate([self.residuals, other.residuals])
        return JointProblem(tau, optimal, residuals, np.append(self.at, other.at + len(self.tau)))

    @cached_property
    def ends(self) -> tuple[float, float]:
        """Least and largest log corner: three decades of tau beyond what is between DC and Nyquist."""
        inner = np.log(self.tau[(self.tau > 0) & (self.tau < np.finfo(float).max)])
        decades = np.log(1000.0)
        return float(inner.min(initial=0.0)) - decades, float(inner.max(initial=-decades)) + decades


def fit_jointly(problem: JointProblem, cover: Cover, max_order: int, tolerance_db: float) -> Bound:
    """Return diagonal magnitudes, left ones first, of the smallest order within the tolerance, or of the largest."""
    sides = np.hstack([cover.left, cover.right]).T
    entries = [(rising_bounds(problem.tau, values, max_order), list[Bound]()) for values in sides]
    for _ in range(max_order + 1):
        for bounds, known in entries:
            known += islice(bounds, 1)
        fitted = refit(problem, Sections.stacked([_simplest(known, tolerance_db) for _, known in entries]))
        if fitted.excess_db <= tolerance_db:
            break
    return fitted


def _simplest(known: list[Bound], tolerance_db: float) -> Sections:
    """Return the fit of the lowest order that is good enough, or as good as the best one but for a tenth."""
    enough = max(tolerance_db / 2, known[-1].excess_db + tolerance_db / 10)
    return next(bound.sections for bound in known if bound.excess_db <= enough)


def refit(problem: JointProblem, start: Sections) -> Bound:
    """Return the best sections of the same orders near a start, raised to be sound."""
    first = start.at(start.parameters, problem.ends)
    state = _State(problem, first, first.parameters)
    for temperature in FIT.temperatures:
        damping = FIT.damping
        for _ in range(FIT.steps):
            better = state.step(temperature, damping)
            if better is None:
                break
            state, damping = better
    return state.fitted()


@frozen
class _Terms:
    """Terms under one smoothed maximum: values, frequencies, and how much every entry moves each."""

    values: AnyArray  # (n,)
    at: AnyArray  # (n,)
    shares: AnyArray  # (n, entry)
    price: float

    def smoothed(self, temperature: float) -> tuple[float, AnyArray]:
        """Return the smoothed maximum, and its derivative by every value."""
        top = float(self.values.max())
        weight = np.exp((self.values - top) / temperature)
        return self.price * (top + temperature * float(np.log(weight.sum()))), weight / weight.sum()


@frozen
class _State:
    """Sections, and what they give at every frequency."""

    problem: JointProblem
    sections: Sections
    start: AnyArray  # parameters

    @cached_property
    def terms(self) -> tuple[_Terms, ...]:
        """Cost, soundness, and the peak of square weights."""
        problem, (p, m) = self.problem, self.problem.residuals.shape[1:]
        logs, count = self.sections.logs(problem.tau), len(problem.tau)
        left, right = logs[:p], logs[p:]
        scaled = problem.residuals * np.exp(-left.T[problem.at][:, :, None] - right.T[problem.at][:, None])
        sigma, shares = _singular(scaled)
        excess = left.mean(axis=0) + right.mean(axis=0) - problem.optimal
        inside = np.flatnonzero(np.isfinite(excess))
        mean = np.broadcast_to(np.repeat([1 / p, 1 / m], [p, m]), (len(inside), p + m))
        price = FIT.peak_price if p == m else 0.0
        cost = _Terms(excess[inside], inside, mean, 1.0)
        sound = _Terms(sigma.ravel(), np.repeat(problem.at, sigma.shape[1]), -shares.reshape(-1, p + m), 1.0 + price)
        if not price:
            return cost, sound
        both = np.repeat(np.tile(np.eye(p), 2), count, axis=0)
        return cost, sound, _Terms((left + right).ravel(), np.tile(np.arange(count), p), both, price)

    def value(self, temperature: float) -> float:
        """Return what is minimised, nepers."""
        away = self.sections.parameters - self.start
        smoothed = sum(terms.smoothed(temperature)[0] for terms in self.terms)
        return smoothed + FIT.pull / 2 * float(away @ away)

    def derivatives(self, temperature: float) -> tuple[AnyArray, AnyArray]:
        """Return the gradient, and the spread of the gradients."""
        gradient = FIT.pull * (self.sections.parameters - self.start)
        spread, slopes = FIT.pull * np.eye(len(self.start)), self.sections.slopes(self.problem.tau)
        for terms in self.terms:
            rows, weight = terms.shares[:, self.sections.owner].T * slopes[:, terms.at], terms.smoothed(temperature)[1]
            mean = rows @ weight
            gradient += terms.price * mean
            spread += terms.price / temperature * ((rows * weight) @ rows.T - np.outer(mean, mean))
        return gradient, spread

    def step(self, temperature: float, damping: float) -> tuple[_State, float] | None:
        """Return the state after one damped step and the damping of the next; None where no step is better."""
        before, (gradient, spread) = self.value(temperature), self.derivatives(temperature)
        for _ in range(FIT.trials):
            move = -np.linalg.solve(spread + damping * np.diag(np.diag(spread)), gradient)
            move *= min(1.0, FIT.farthest / max(float(np.abs(move).max()), TINY))
            trial = replace(self, sections=self.sections.at(self.sections.parameters + move, self.problem.ends))
            if trial.value(temperature) < before:
                return trial, max(damping / 4, 1e-6)
            damping *= 8
        return None

    def fitted(self) -> Bound:
        """Return the sections, raised to be sound, and the largest excess of their cost."""
        excess, deficit = (float(terms.values.max()) for terms in self.terms[:2])
        lifted = self.sections.lifted(slice(0, self.problem.residuals.shape[1]), deficit)
        return Bound(lifted, (excess + deficit) * NEPER_DB)


def _singular(matrices: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return log singular values, (n, rank), and squared moduli of the entries of their vectors, left then right."""
    other, wide = adjoint(matrices), matrices.shape[1] <= matrices.shape[2]
    squares, short = np.linalg.eigh(matrices @ other if wide else other @ matrices)
    long = np.abs((other if wide else matrices) @ short) ** 2
    long /= np.maximum(long.sum(axis=1, keepdims=True), TINY)
    parts = (np.abs(short) ** 2, long) if wide else (long, np.abs(short) ** 2)
    return np.log(np.maximum(squares, TINY)) / 2, np.swapaxes(np.concatenate(parts, axis=1), 1, 2)
