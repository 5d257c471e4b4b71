r"""Ridge regression of all states on the bank, its penalty chosen on units and episodes that are left out.

Rows :math:`\xi_k` of the bank, divided by their sizes, have principal directions and singular values
:math:`\sigma_i`. In whitened directions the penalty of the bank's own coefficients is :math:`\lambda / \sigma_i^2`.
Rows with target zero say how far an entry may be wrong. Moments of units, conditions and parts of the episodes are
summed once; leaving some out is a difference of moments. Units often follow the same references: errors are those of
coefficients that know neither the unit nor its episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from ...core import EPS, ROUNDING, AnyArray, Array, Flags, Whole, frozen
from ...core.linalg import qr_triangle
from .rows import Design, Group, Recordings, Sample

Candidate = tuple[float, float, float]  # penalty, and weights of starts elsewhere and of restarts
_SMALLEST = 5e4 * EPS  # of singular values: what is smaller is rounding


@frozen
class Whitening:
    """Principal directions of the bank."""

    sample: Array  # triangle of thinned rows, from which they are found
    directions: Array  # (p, r)
    inverse: Array  # (r, p), rows of the bank by their parts in these directions
    penalty: Array  # (r,), 1 / sigma^2
    trust: Array  # (r, r), moments of the rows that say how far entries may be wrong
    disturbed: Array  # (r, r), the same after a start in the middle of an episode
    elsewhere: Array  # (r, r), the same of a start at another place

    @classmethod
    def of(cls, design: Design, sample: Sample) -> Whitening:
        """Find the directions from thinned rows, and what rows with errors of weights add."""
        bank, settings = design.bank, design.settings
        size = bank.sizes(np.linalg.norm(sample.rows, axis=0))
        disturbed, elsewhere = sample.restarts / size, sample.elsewhere / size
        trust = np.vstack([np.diag(settings.nonlinear_trust * (bank.channel >= bank.linear)), sample.errors / size])
        starts = np.sqrt(settings.settled_share) * disturbed, np.sqrt(settings.start_share) * elsewhere
        _, sigma, V = np.linalg.svd(qr_triangle(np.vstack([sample.rows / size, trust, *starts])))
        count = int(np.sum(sigma > _SMALLEST * sigma[0]))
        sigma, V = sigma[:count], V[:count]
        directions, inverse = V.T / sigma, sigma[:, None] * V * size
        moments = (rows.T @ rows for rows in (each @ directions for each in (trust, disturbed, elsewhere)))
        return cls(sample.rows, directions / size[:, None], inverse, sigma**-2.0, *moments)


@frozen
class Moments:
    """Second moments of every group in whitened directions."""

    whitening: Whitening
    groups: tuple[Group, ...]
    gram: Array  # (groups, r, r)
    cross: Array  # (groups, r, n)
    power: Array  # (groups, n)
    rows: Array  # (groups,), how many there are

    @classmethod
    def of(cls, designs: Sequence[Design], whitenings: Sequence[Whitening]) -> list[Moments]:
        """Sum the rows of every group, for every design: their banks are parts of that of the last."""
        last, whitening = designs[-1], whitenings[-1]
        some = last.recordings.some(last.settings.episodes, last.groups)
        groups = tuple(dict.fromkeys(last.groups[key] for key in some.keys))
        count, r, n = len(groups), len(whitening.penalty), len(last.recordings.size)
        gram, cross, power, total = (np.zeros((count, *shape)) for shape in ((r, r), (r, n), (n,), ()))
        for key, rows, targets, weights in last.rows(some, last.settings.rows):
            group, root = groups.index(last.groups[key]), np.sqrt(weights)[:, None]
            white, wanted = root * (rows @ whitening.directions), root * targets
            gram[group] += white.T @ white
            cross[group] += white.T @ wanted
            power[group] += (wanted**2).sum(axis=0)
            total[group] += weights.sum()
        for sums in (gram, cross, power):
            np.divide(sums.T, total, out=sums.T)
        whole = cls(whitening, groups, gram, cross, power, total)
        parts = zip(whitenings[:-1], designs[:-1], strict=True)
        return [*(whole.part(one, last.bank.places(design.bank)) for one, design in parts), whole]

    def part(self, whitening: Whitening, entries: Whole) -> Moments:
        """Return the moments of some entries of the bank, in their own directions."""
        into = self.whitening.inverse[:, entries] @ whitening.directions
        gram = np.array([into.T @ one @ into for one in self.gram])
        return replace(self, whitening=whitening, gram=gram, cross=into.T @ self.cross)

    def of_groups(self, what: str) -> AnyArray:
        """Return fold, condition or part of every group."""
        return np.array([getattr(group, what) for group in self.groups])

    def errors(self, coefficients: Array, groups: slice = slice(None)) -> Array:
        """Return the mean squared errors of coefficients (candidates, r, n), shape (groups, candidates, n)."""
        flat = coefficients.swapaxes(0, 1).reshape(coefficients.shape[1], -1)
        quadratic = (flat * (self.gram[groups] @ flat)).sum(axis=1).reshape(-1, *coefficients.shape[::2])
        mixed = np.einsum("crn,grn->gcn", coefficients, self.cross[groups])
        return np.maximum(self.power[groups, None] - 2 * mixed + quadratic, 1e-30)

    def solved(self, weights: Array, candidates: Sequence[Candidate]) -> Array:
        """Return ridge coefficients of groups with weights, for every candidate, shape (candidates, r, n)."""
        from scipy.linalg import cho_factor, cho_solve

        weights = weights / weights.sum()
        whitening = self.whitening
        gram = np.tensordot(weights, self.gram, 1) + whitening.trust
        cross = np.tensordot(weights, self.cross, 1)
        rounding = 1 + 16 * len(gram) * EPS
        whole = {
            (start, restart): gram + start * whitening.elsewhere + restart * whitening.disturbed
            for start, restart in {candidate[1:] for candidate in candidates}
        }
        found = np.zeros((len(candidates), *cross.shape))
        for i, (penalty, start, restart) in enumerate(candidates):
            A = whole[start, restart].copy()
            A.flat[:: len(A) + 1] = rounding * (np.diag(A) + penalty * whitening.penalty)
            factor = cho_factor(A.T, lower=True, overwrite_a=True, check_finite=False)  # as LAPACK stores it: no copies
            found[i] = cho_solve(factor, cross, check_finite=False)
        return found

    def best(self, errors: Array, among: Flags | slice = slice(None)) -> Whole:
        """Return the best candidates of every state for each set of weights, which come in turn, shape (2 n,).

        They are best by logarithms of errors (groups, candidates, n) on what is left out, among all groups or some.
        """
        # A state at zero throughout a group would ask for no estimate of it at all.
        counted = (self.power[among] > 0)[:, None]
        mean = np.log(errors[among]).mean(axis=0, where=counted | ~counted.any(axis=0))
        return np.concatenate([2 * mean[i::2].argmin(axis=0) + i for i in range(2)])

    def known(self, group: Group) -> Flags:
        """Return the groups without units and episodes of one; if none is left in its condition, without either."""
        alike = self.of_groups("condition") == group.condition
        folds, parts = self.of_groups("fold") != group.fold, self.of_groups("part") != group.part
        return next(known for known in (folds & parts, folds, parts, folds | True) if (known & alike).any())

    def without(self, weights: Array, candidates: Sequence[Candidate]) -> dict[Group, Array]:
        """Return the coefficients that do not know a group, for every group and candidate."""
        known = {group: self.known(group) for group in self.groups}
        several = {rest.tobytes(): np.where(rest, weights, 0.0) for rest in known.values()}
        found = {key: self.solved(rest, candidates) for key, rest in several.items()}
        return {group: found[rest.tobytes()] for group, rest in known.items()}


@frozen
class Readout:
    """Coefficients of all states on a bank, in the channels' units, with errors on units and episodes left out."""

    design: Design
    sample: Array  # triangle of thinned rows of the bank
    coefficients: Array  # (p, 2 n): of all states, and of these for the time after a start
    left_out: Array  # (groups, n), mean squared errors over the squared sizes
    trained: Array  # (groups, n), of the coefficients that are returned
    others: dict[Group, Array]  # coefficients (p, 2 n) that do not know a group, over the sizes

    @classmethod
    def of(cls, designs: Sequence[Design]) -> list[Readout]:
        """Fit all states by every design, in two passes over the recordings; the last bank holds the others."""
        last = designs[-1]
        sample = last.sample()
        whitenings = [Whitening.of(design, sample.of(last.bank.places(design.bank))) for design in designs]
        return [cls._fitted(*each) for each in zip(designs, Moments.of(designs, whitenings), strict=True)]

    @classmethod
    def _fitted(cls, design: Design, moments: Moments) -> Readout:
        """Fit all states: conditions count inversely to their errors, penalties are best on what is left out."""
        whitening = moments.whitening
        settings = design.settings
        weights = condition_weights(moments, settings.restart_share)
        weights_of = (0.0, settings.settled_share), (settings.start_share, settings.restart_share)
        candidates = [(penalty, *each) for penalty, each in product(settings.penalties, weights_of)]
        others = moments.without(weights, candidates)
        errors = np.concatenate([moments.errors(others[g], slice(i, i + 1)) for i, g in enumerate(moments.groups)])
        folds, n = moments.of_groups("fold"), moments.power.shape[1]
        states, best = np.tile(np.arange(n), 2), moments.best(errors)
        coefficients = moments.solved(weights, candidates)[best, :, states].T
        # What is left out took no part in the choice that it is judged with.
        nested = [moments.best(errors, folds != fold if np.ptp(folds) else slice(None)) for fold in folds]
        unaware = zip(others.items(), nested, strict=True)
        return cls(
            design,
            whitening.sample,
            whitening.directions @ coefficients * np.tile(design.recordings.size, 2),
            np.array([errors[i, choice[:n], states[:n]] for i, choice in enumerate(nested)]),
            moments.errors(coefficients[None, :, :n])[:, 0],
            {g: whitening.directions @ each[choice, :, states].T for (g, each), choice in unaware},
        )

    def left_out_groups(self) -> list[tuple[Group, Recordings]]:
        """Return a group of every fold, and the recordings of its fold and part: what `without` it does not know."""
        groups, recordings, parts = self.design.groups, self.design.recordings, self.design.settings.parts
        found = []
        for fold in dict.fromkeys(group.fold for group in self.others):
            of_fold = [group for group in self.others if group.fold == fold]
            chosen = min(of_fold, key=lambda group: (group.part - group.fold) % parts)
            same = [(groups[key].fold, groups[key].part) == (fold, chosen.part) for key in recordings.keys]
            found.append((chosen, recordings.only(same)))
        return found

    @property
    def typical(self) -> Array:
        """Typical left-out error of every state over its size, shape (n,)."""
        return np.exp(np.log(self.left_out).mean(axis=0) / 2)

    def without(self, group: Group) -> Readout:
        """Return the readout that does not know a group."""
        return replace(self, coefficients=self.others[group] * np.tile(self.design.recordings.size, 2))

    def by_fold(self, states: Sequence[int]) -> Array:
        """Return the mean logarithm of the left-out mean squared errors of some states, shape (folds,)."""
        folds, errors = np.array([g.fold for g in self.others]), np.log(self.left_out[:, list(states)]).mean(axis=1)
        return np.array([errors[folds == fold].mean() for fold in np.unique(folds)])

    def episode_errors(self) -> Array:
        """Return the left-out mean squared errors of every episode over the squared sizes, shape (episodes, n)."""
        design, found = self.design, []
        for key, rows, targets, weights in design.rows(design.recordings, design.settings.rows):
            errors = targets - rows @ self.others[design.groups[key]][:, : targets.shape[1]]
            found.append(np.average(errors**2, axis=0, weights=weights))
        return np.array(found)


def is_less(one: Array, other: Array, margin: float) -> bool:
    """Whether one is less than the other by so many paired standard errors."""
    difference = one - other
    error = difference.std(ddof=1) / np.sqrt(len(difference)) if len(difference) > 1 else 0.0
    return bool(difference.mean() + margin * error < 0)


def condition_weights(moments: Moments, restart: float) -> Array:
    """Return weights of the groups: by rows within a condition, conditions inversely to the errors of a first fit."""
    conditions = moments.of_groups("condition")
    alike = conditions[:, None] == conditions
    first = moments.solved(moments.rows, [(ROUNDING, 0.0, restart)])
    errors = np.exp(np.log(moments.errors(first)).mean(axis=(1, 2)))
    return moments.rows / (alike @ moments.rows) * alike.sum(axis=1) ** 2 / (alike @ errors)
