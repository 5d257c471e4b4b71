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

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

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
    residuals: AnyArray  # (unit, frequency, p', m'), complex

    @cached_property
    def ends(self) -> tuple[float, float]:
        """Least and largest log corner: three decades of tau beyond what is between DC and Nyquist."""
        inner = np.log(self.tau[(self.tau > 0) & (self.tau < np.finfo(float).max)])
        decades = np.log(1000.0)
        return float(inner.min(initial=0.0)) - decades, float(inner.max(initial=-decades)) + decades


def fit_jointly(problem: JointProblem, cover: Cover, max_order: int, tolerance_db: float) -> Bound:
    """Return diagonal magnitudes, left ones first, of the smallest order within the tolerance, or of the largest."""
    sides = np.hstack([cover.left, cover.right]).T
    enough = tolerance_db / 2  # of each side: together they are within the tolerance
    for bounds in zip(*(rising_bounds(problem.tau, values, max_order, enough) for values in sides), strict=True):
        fitted = refit(problem, Sections.stacked([bound.sections for bound in bounds]))
        if fitted.excess_db <= tolerance_db:
            break
    return fitted


def refit(problem: JointProblem, start: Sections, temperatures: Sequence[float] = FIT.temperatures) -> Bound:
    """Return the best sections of the same orders near a start, raised to be sound."""
    first = start.at(start.parameters, problem.ends)
    state = _State(problem, first, first.parameters)
    for temperature in temperatures:
        damping = FIT.damping
        for _ in range(FIT.steps):
            better = state.step(temperature, damping)
            if better is None:
                break
            state, damping = better
    return state.fitted()


@frozen
class _Terms:
    """Terms under one smoothed maximum, and how much every entry moves each."""

    price: float
    values: AnyArray  # (n, frequency)
    shares: AnyArray  # (entry, n, frequency)

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
        E, logs = self.problem.residuals, self.sections.logs(self.problem.tau)
        p, m = E.shape[2:]
        left, right = logs[:p], logs[p:]
        sound, shares = _singular(E * np.exp(-left.T[:, :, None] - right.T[:, None]))
        mean = np.repeat([1 / p, 1 / m], [p, m])
        price = FIT.peak_price if p == m else 0.0
        terms = (
            _Terms(1.0, (mean @ logs - self.problem.optimal)[None], mean[:, None, None]),
            _Terms(1.0 + price, sound, -shares),
        )
        if not price:
            return terms
        return *terms, _Terms(price, left + right, np.tile(np.eye(p), (2, 1))[..., None])

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
            weight = terms.smoothed(temperature)[1].ravel()
            rows = (terms.shares[self.sections.owner] * slopes[:, None]).reshape(len(slopes), -1)
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
        level = self.sections.level + deficit * (np.arange(len(self.sections.level)) < self.problem.residuals.shape[2])
        return Bound(replace(self.sections, level=level), (excess + deficit) * NEPER_DB)


def _singular(matrices: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return log singular values of (unit, frequency, p, m) and squared moduli of their vectors, entries first."""
    squares, right = np.linalg.eigh(adjoint(matrices) @ matrices)
    left = np.abs(matrices @ right) ** 2
    left /= np.maximum(left.sum(axis=-2, keepdims=True), TINY)
    shares = np.moveaxis(np.concatenate([left, np.abs(right) ** 2], axis=-2), (-2, -1), (0, 1))
    count, n_freqs = len(matrices) * matrices.shape[-1], matrices.shape[1]
    logs = np.log(np.maximum(np.moveaxis(squares, -1, 0), TINY)) / 2
    return logs.reshape(count, n_freqs), shares.reshape(-1, count, n_freqs)
