r"""Diagonal weights: starts from covers that are easy to follow, a joint fit of the most promising ones, and moves between local optima.

One right entry is one (the gauge of `cover`), so that p' + m' - 1 magnitudes are fitted. The joint fit has local optima, therefore several
starts: covers pulled towards equal entries by different amounts, in two gauges, smoothed over about an eighth of a decade, are followed entry
by entry in the least-squares sense and go down together, on few frequencies and units until it shows which are good. The best two go on with
all. Where the excess stays large, poles and zeros are added where the fit gains most from them, and those that do least are taken out: the
order is the same, and the optimum often a better one.

Orders: of at most four to begin with. Within the tolerance they are lowered entry by entry, beyond it raised by two until the largest order.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import KrosError
from ...core.small_matrices import entries_first, sigma_max_first
from ..weights.cover import Cover, optimal_cover
from .joint import NEPER_DB, Fitted, JointFit, follow
from .magnitude import majorant
from .sections import Sections
from .spectral import log_knots

Array = npt.NDArray[Any]

_LOG = logging.getLogger(__name__)

_PULLS = (0.03, 0.1, 1.0)
_GAUGES, _EVEN = 2, (0.3, 1.0)  # right entries that are one, shares of knots that are evenly spaced
_COARSE = 3  # every third frequency, and the two largest units of each, decide between starts
_UNITS = 4  # per frequency in the fit; the check sees all
_KEPT = 2
_QUICK = (1, 3)
_FLOOR = 1e-8  # magnitudes below this fraction of the largest count as this fraction (-160 dB)
_SMOOTHING_DECADES = 0.15
_WIDTH = np.log(8.0)  # of the first sections
_FOLLOW = 15
_SCREEN, _SCREEN_STEPS = (0.5, 0.2, 0.1, 0.05), 8  # temperatures, nepers
_POLISH, _POLISH_STEPS = (0.05, 0.012, 0.003), 15
_JUMP, _JUMP_STEPS = (0.1, 0.05, 0.02), 8
_JUMPS = 3
_START_ORDER = 4
_IDLE_DB = 6.0  # poles and zeros that do more than this are not tried to be left out
_STALLED = 0.97
_UNSATISFIED = 1.4  # tolerances beyond which scalar weights are a start, too
_ENOUGH = 0.95  # of the tolerance: what is found between the points of the fit costs a little more


@dataclass(frozen=True, eq=False)
class Problem:
    """Residuals at the frequencies of a fit."""

    freqs_hz: Array  # (frequency,)
    tau: Array  # (frequency,)
    residuals: Array  # (unit, frequency, p', m')
    optimal: Array  # (frequency,), nepers: cost of the optimal cover, infinite beyond the band
    ratio: Array  # (unit, frequency): of the residuals to such a cover, or to a weight: which units lead

    def joint(self, units: int = _UNITS, step: int = 1) -> JointFit:
        """Return the joint fit with the leading units of every frequency."""
        kept = self.some(step)
        leading = np.argsort(-self.ratio[:, kept], axis=0)[:units]
        at = np.broadcast_to(np.arange(len(kept)), leading.shape).ravel()
        return JointFit(self.residuals[leading.ravel(), kept[at]], at, self.tau[kept], self.optimal[kept])

    def some(self, step: int) -> Array:
        """Indices of some frequencies, the ends and the peaks of the cost among them."""
        cost = np.where(np.isfinite(self.optimal), self.optimal, -np.inf)
        peaks = np.flatnonzero((cost[1:-1] > cost[:-2]) & (cost[1:-1] >= cost[2:])) + 1
        return np.unique(np.concatenate([np.arange(0, len(self.tau), step), peaks, [len(self.tau) - 1]]))

    def joined(self, other: Problem) -> Problem:
        """Return both, frequencies increasing and none twice; of equal ones the other's stay."""
        freqs, index = np.unique(np.concatenate([other.freqs_hz, self.freqs_hz]), return_index=True)
        both = (
            np.concatenate([getattr(other, x), getattr(self, x)], axis=-1)[..., index]
            for x in ("tau", "optimal", "ratio")
        )
        tau, optimal, ratio = both
        return Problem(freqs, tau, np.concatenate([other.residuals, self.residuals], axis=1)[:, index], optimal, ratio)

    def covers(self) -> Iterator[tuple[int, Cover]]:
        """Covers that are easy to follow, each with its right entry that is one."""
        kept, inside = self.some(_COARSE), np.isfinite(self.optimal)
        x, x_kept = np.log(self.freqs_hz.clip(1e-300)), np.log(self.freqs_hz[kept].clip(1e-300))
        for pull in _PULLS:
            cover = optimal_cover(self.residuals[:, kept], pull=pull, squarings=_QUICK)
            for reference in np.argsort(-np.median(cover.right, axis=0), kind="stable")[:_GAUGES]:
                own = cover.regauged(int(reference))
                floor = _FLOOR * own.left.max(axis=0)
                left, right = (
                    _level(np.exp([np.interp(x, x_kept, column) for column in np.log(side).T]).T, inside)
                    for side in (np.maximum(own.left, floor), _smoothed(own.right, self.freqs_hz[kept]))
                )
                yield int(reference), Cover(left, right)


def fit_sections(problem: Problem, max_order: int, tolerance_db: float) -> Fitted:
    """Return magnitudes of a diagonal weight, left ones first: of the lowest orders found within the tolerance, or the best up to the largest."""
    joint, order = problem.joint(), max_order if max_order <= _START_ORDER else _START_ORDER - max_order % 2
    found = _jumped(joint, _first(problem, joint, _starts(problem, joint, order), tolerance_db), tolerance_db)
    if found.excess_db > _UNSATISFIED * tolerance_db:
        others = list(_from_scalar(problem, joint, order))
        if others:
            found = min(found, _jumped(joint, _first(problem, joint, others, tolerance_db), tolerance_db), key=_excess)
    while found.excess_db > tolerance_db and order + 2 <= max_order:
        order += 2
        higher = joint.descend(joint.grown(found.sections, _JUMP[1]), _JUMP[:1] + _POLISH, _POLISH_STEPS)
        found = _jumped(joint, min(found, higher, key=_excess), tolerance_db)
    return _lowered(joint, found, tolerance_db) if found.excess_db <= tolerance_db else found


def refit(problem: Problem, known: Sections) -> Fitted:
    """Return the magnitudes with what was missed in the problem."""
    return problem.joint().descend(known, _POLISH, _POLISH_STEPS)


def _first(problem: Problem, joint: JointFit, starts: Iterable[Sections], tolerance_db: float) -> Fitted:
    """Best of several starts, the first within the tolerance."""
    coarse, screened = problem.joint(2, _COARSE), []
    for start in starts:
        screened.append(coarse.descend(start, _SCREEN, _SCREEN_STEPS, tolerance_db))
        if screened[-1].excess_db <= tolerance_db:
            break
    found: list[Fitted] = []
    for promising in sorted(screened, key=_excess)[:_KEPT]:
        found.append(joint.descend(promising.sections, _POLISH, _POLISH_STEPS, _ENOUGH * tolerance_db))
        if found[-1].excess_db <= tolerance_db:
            break
    return min(found, key=_excess)


def _starts(problem: Problem, joint: JointFit, order: int) -> Iterator[Sections]:
    """Covers followed entry by entry."""
    for reference, cover in problem.covers():
        logs = np.log(np.hstack([cover.left, cover.right])).T
        orders = [order] * len(logs)
        orders[cover.left.shape[1] + reference] = 0
        for even in _EVEN if order > 1 else _EVEN[:1]:
            corners = [log_knots(problem.tau, row, (n + 1) // 2, even) for row, n in zip(logs, orders, strict=True)]
            yield follow(problem.tau, logs, Sections.spread(corners, orders, _WIDTH), joint.ends(), _FOLLOW)


def _from_scalar(problem: Problem, joint: JointFit, order: int) -> Iterator[Sections]:
    """The scalar magnitude of the order in all left entries, ones with poles upon zeros in the right ones; none where there is no such magnitude."""
    inside, (p, m) = np.isfinite(problem.optimal), problem.residuals.shape[2:]
    size = _level(sigma_max_first(entries_first(problem.residuals)).max(axis=0), inside)
    scalar = majorant(problem.tau, size, order)
    if scalar is None:
        return
    cover = optimal_cover(problem.residuals[:, problem.some(_COARSE)], pull=_PULLS[1], squarings=_QUICK)
    for reference in np.argsort(-np.median(cover.right, axis=0), kind="stable")[:_GAUGES]:
        orders = [0] * p + [0 if j == reference else order for j in range(m)]
        corners = [log_knots(problem.tau, np.log(size), (n + 1) // 2, _EVEN[0]) for n in orders]
        try:
            yield Sections.spread(corners, orders, _WIDTH).like(np.arange(p), scalar)
        except KrosError as error:
            _LOG.debug("Diagonal weights: the scalar magnitude is no start (%s)", error)


def _jumped(joint: JointFit, found: Fitted, tolerance_db: float) -> Fitted:
    """Move to better local optima of the same orders by way of higher ones."""
    for _ in range(_JUMPS):
        if found.excess_db <= tolerance_db:
            break
        sections = joint.descend(joint.grown(found.sections, _JUMP[1]), _JUMP, _JUMP_STEPS).sections
        for entry in np.flatnonzero(sections.orders > 0):
            idle = sections.idlest(int(entry), joint.tau)
            sections = sections if idle is None else sections.without(idle)
        other = joint.descend(sections, _JUMP[:1] + _POLISH, _POLISH_STEPS)
        better = (sections.orders <= found.sections.orders).all() and other.excess_db < found.excess_db
        enough = better and other.excess_db < _STALLED * found.excess_db
        found = other if better else found
        if not enough:
            break
    return found


def _lowered(joint: JointFit, found: Fitted, tolerance_db: float) -> Fitted:
    """Leave out poles and zeros that cancel, the idlest first, as long as the tolerance holds."""
    pending = set(np.flatnonzero(found.sections.orders > 0).tolist())
    while pending:
        idles = [idle for entry in pending if (idle := found.sections.idlest(entry, joint.tau)) is not None]
        idles = [idle for idle in idles if idle.span * NEPER_DB < _IDLE_DB]
        if not idles:
            break
        idle = min(idles, key=lambda i: i.span)
        fewer = [found.sections.without(idle)] + (
            [found.sections.halved(idle)] if found.sections.pair[idle.zero] else []
        )
        for sections in fewer:
            lower = joint.descend(sections, _POLISH, _POLISH_STEPS, _ENOUGH * tolerance_db)
            if lower.excess_db <= tolerance_db:
                found = lower
                break
        else:
            pending.discard(idle.entry)
    return found


def _excess(fitted: Fitted) -> float:
    return fitted.excess_db if np.isfinite(fitted.excess_db) else np.inf


def _level(values: Array, inside: Array) -> Array:
    """Values within the band, and beyond it the one at its end."""
    band = np.flatnonzero(inside)
    return values[np.clip(np.arange(len(values)), band[0], band[-1])]


def _smoothed(values: Array, freqs_hz: Array) -> Array:
    """Gaussian average of log values over log frequency; columns are smoothed one by one."""
    x = np.log10(np.maximum(freqs_hz, freqs_hz[freqs_hz > 0].min(initial=np.inf)))
    kernel = np.exp(-0.5 * ((x[:, None] - x) / _SMOOTHING_DECADES) ** 2) * (
        np.gradient(x).clip(1e-12) if len(x) > 1 else 1.0
    )
    return np.exp(kernel @ np.log(values) / kernel.sum(axis=1, keepdims=True))
