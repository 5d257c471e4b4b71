r"""Fits of weights: what is fitted, against what, and the check at the end.

All entries of diagonal weights are fitted together (`diagonal`, `joint`), against the cost of the optimal cover, of which no single choice has
to be followed; entrywise weights are one scalar fit for every entry. What counts is the check at the end: on a grid ten times denser with DC and
Nyquist, and between its points as far as the residuals allow (`certificate`), for the systems as returned. Where it fails, the worst frequencies and
units join the fit, and at last the left weight is scaled until it touches.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.frequency import bilinear_squared
from ...core.lti import block_diagonal, gain
from ..fits.diagonal import Problem, fit_sections, refit
from ..fits.magnitude import fit_magnitude
from ..fits.sections import Sections
from .certificate import Certificate, Method
from .check import Checks, Residuals, joined
from .cover import Cover, Structure, as_structure, cover_ratio, optimal_cover
from .pencils import ResidualSystems
from .weight import EntrywiseWeight, Weight, unstructured_excess

Array = npt.NDArray[Any]

_LOG = logging.getLogger(__name__)
_MARGIN = 1e-9
_LIFT = 1.02  # a deficit up to here is lifted, a larger one refines the grid
_ROUNDS = 4
_WORST = 20  # frequencies added in a round
_POINTS = 160  # of the grid in the joint fit
_MISSED_DB = 0.05  # a cost higher than this between the points of the fit brings further ones
_PROOFS = 2  # fits, each with the frequencies at which the proof found the one before exceeded


def fit_weight(
    residuals: Residuals,
    freqs_hz: Array,
    sample_period_s: float,
    *,
    structure: Structure | str = Structure.DIAGONAL,
    max_order: int = 4,
    tolerance_db: float = 1.0,
    systems: ResidualSystems | None = None,
    also_hz: npt.ArrayLike | None = None,
    sampled: bool = False,
) -> tuple[Weight, Cover]:
    """Fit weights to residuals, a function of frequencies (n,), Hz, and return them with the optimal cover at `freqs_hz`."""
    structure = as_structure(structure)
    checks = Checks(None if also_hz is None else np.asarray(also_hz, float), systems, sampled)
    fit = _fit_entries if structure is Structure.ENTRYWISE else _fit_checked
    return fit(residuals, freqs_hz, sample_period_s, structure, (max_order, tolerance_db), checks)


def _fit_checked(
    residuals: Residuals, freqs_hz: Array, dt: float, structure: Structure, limits: tuple[int, float], checks: Checks
) -> tuple[Weight, Cover]:
    """Scalar or diagonal weights; `limits` are the largest order and the tolerance."""
    fitter, claimed = _Fitter(residuals, dt, *limits, (freqs_hz[0], freqs_hz[-1])), checks.claimed(freqs_hz, dt)
    checked, of_fit, lowest = fitter.sampled(checks.grid(freqs_hz, dt)), checks.of_fit(freqs_hz), 0

    def ratio(at_hz: Array) -> Array:
        return fitter.sampled(at_hz).ratio(unscaled)

    for _ in range(_PROOFS):
        grid = fitter.sampled(of_fit)
        if structure is Structure.DIAGONAL and grid.E.any() and grid.E.shape[2:] != (1, 1):
            unscaled = fitter.diagonal(grid, checked)
        else:  # of one entry, diagonal weights are scalar ones
            unscaled = fitter.scalar(grid, checked, structure, lowest)
        proof = checks.proof(ratio, claimed, unscaled.left, unscaled.right)
        found = fitter.sampled(np.array([proof.freq_hz]))
        if proof.peak <= _LIFT * max(1.0, float(checked.ratio(unscaled).max(initial=0.0))):
            break
        checked, of_fit = checked.joined(found), joined(of_fit, found.freqs_hz)[0]
        lowest = max(max(unscaled.left_orders) - 1, 0)  # further points do not make a lower order better
    best = fitter.cover(fitter.sampled(freqs_hz), structure)
    inside = np.isin(checked.freqs_hz, claimed)
    weight = _lifted(unscaled, checked if inside.all() else checked.some(inside), proof)
    return weight.measured(freqs_hz, best, fitter.tolerance_db), best


def _fit_entries(
    residuals: Residuals, freqs_hz: Array, dt: float, structure: Structure, limits: tuple[int, float], checks: Checks
) -> tuple[EntrywiseWeight, Cover]:
    """A scalar weight for every entry; the cover is ones, and the largest entries of the residuals row by row."""
    E = residuals(freqs_hz)
    p, m = E.shape[2:]

    def fit(i: int, j: int) -> Weight:
        systems = None if checks.systems is None else replace(checks.systems, entry=(i, j))
        entry = replace(checks, systems=systems)
        return _fit_checked(
            lambda f: residuals(f)[:, :, i : i + 1, j : j + 1], freqs_hz, dt, Structure.SCALAR, limits, entry
        )[0]

    fits = [fit(i, j) for i, j in np.ndindex(p, m)]
    sizes = np.abs(E).max(axis=0).reshape(len(freqs_hz), p * m)
    fitted, some = np.hstack([w.magnitudes(freqs_hz).left for w in fits]), sizes.min(axis=1) > 0
    rows, columns = np.kron(np.eye(p), np.ones((1, m))), np.tile(np.eye(m), (p, 1))
    weight = EntrywiseWeight(
        left=gain(rows, dt),
        right=block_diagonal([w.left for w in fits]) @ gain(columns, dt),
        left_orders=(0,) * (p * m),
        right_orders=tuple(w.left_orders[0] for w in fits),
        structure=structure,
        cover_max=max(w.cover_max for w in fits),
        overbound_db_max=float((20 * np.log10(fitted[some] / sizes[some])).mean(axis=1).max(initial=0.0)),
        within_tolerance=all(w.within_tolerance for w in fits),
        method=Method.LEVEL_SETS if all(w.method is Method.LEVEL_SETS for w in fits) else Method.GRID,
        remaining_margin=min(w.remaining_margin for w in fits),
    )
    dense = checks.claimed(freqs_hz, dt)
    excess = unstructured_excess(weight.matrix().frequency_response(dense), residuals(dense))
    return replace(weight, unstructured_excess=excess), Cover(np.ones_like(sizes), sizes)


@dataclass(frozen=True, eq=False)
class _Sampled:
    """Residuals at some frequencies."""

    freqs_hz: Array
    E: Array

    @cached_property
    def _ratios(self) -> list[tuple[Weight, Array]]:
        return []

    def ratio(self, weight: Weight) -> Array:
        """Largest ratio for every unit and frequency; that of the last weight is kept, for fits are checked where they are proven."""
        if not self._ratios or self._ratios[0][0] is not weight:
            used = weight.magnitudes(self.freqs_hz)
            self._ratios[:] = [(weight, cover_ratio(self.E, used.left, used.right))]
        return self._ratios[0][1]

    def some(self, index: Array) -> _Sampled:
        """Return those of some frequencies."""
        return _Sampled(self.freqs_hz[index], self.E[:, index])

    def chosen(self, other: _Sampled, index: Array) -> _Sampled:
        """Return some of these and of others, by their indices in both, one after the other; both may be large."""
        count = len(self.freqs_hz)
        own, theirs = np.flatnonzero(index < count), np.flatnonzero(index >= count)
        order = np.argsort(np.concatenate([own, theirs]))
        E = np.concatenate([self.E[:, index[own]], other.E[:, index[theirs] - count]], axis=1)
        return _Sampled(np.concatenate([self.freqs_hz, other.freqs_hz])[index], E[:, order])

    def joined(self, other: _Sampled) -> _Sampled:
        """Return the same with further frequencies."""
        freqs, index = joined(self.freqs_hz, other.freqs_hz)
        return _Sampled(freqs, np.concatenate([self.E, other.E], axis=1)[:, index])


@dataclass(frozen=True, eq=False)
class _Fitter:
    """Residuals, and settings of the fits to them."""

    residuals: Residuals
    sample_period_s: float
    max_order: int
    tolerance_db: float
    band_hz: tuple[float, float]

    @cached_property
    def _known(self) -> dict[bytes, _Sampled]:
        return {}

    def sampled(self, freqs_hz: Array) -> _Sampled:
        """Return the residuals at some frequencies."""
        key = freqs_hz.tobytes()
        if key not in self._known:
            self._known[key] = _Sampled(freqs_hz, self.residuals(freqs_hz))
        return self._known[key]

    @cached_property
    def _covers(self) -> dict[tuple[Structure, bytes], Cover]:
        return {}

    def cover(self, points: _Sampled, structure: Structure = Structure.DIAGONAL) -> Cover:
        """Return the optimal cover; the one that a weight is fitted to is most often the one that it is measured against."""
        key = structure, points.freqs_hz.tobytes()
        if key not in self._covers:
            self._covers[key] = optimal_cover(points.E, structure)
        return self._covers[key]

    def inside(self, freqs_hz: Array) -> Array:
        """Whether frequencies are within the band that was asked for."""
        return (freqs_hz >= self.band_hz[0]) & (freqs_hz <= self.band_hz[1])

    def scalar(self, grid: _Sampled, checked: _Sampled, structure: Structure, lowest: int) -> Weight:
        """One magnitude for the largest singular values, fitted again with the frequencies at which it is exceeded."""
        dt, (p, m) = self.sample_period_s, grid.E.shape[2:]
        options: dict[str, Any] = {"max_order": self.max_order, "tolerance_db": self.tolerance_db}
        for _ in range(_ROUNDS):
            size = optimal_cover(grid.E, Structure.SCALAR).left[:, 0]
            fit = fit_magnitude(grid.freqs_hz, size, dt, min_order=lowest, **options)
            lowest = max(fit.order - 1, 0)
            left = block_diagonal([fit.system] * p)
            weight = Weight(left, gain(np.eye(m), dt), (fit.order,) * p, (0,) * m, structure, np.nan, np.nan)
            ratio = checked.ratio(weight).max(axis=0)
            if ratio.max(initial=0.0) <= _LIFT:
                break
            _LOG.debug("Weight: exceeded %.3f times between grid points, refining the grid", ratio.max())
            grid = grid.joined(checked.some(_peaks(ratio)))
        return weight

    def diagonal(self, grid: _Sampled, checked: _Sampled) -> Weight:
        """Joint fit, and again with the frequencies and units at which it is exceeded or costs more than it should."""
        best = self.cover(grid)
        size, beyond = (
            optimal_cover(grid.E, Structure.SCALAR).left[:, 0],
            np.flatnonzero(~self.inside(checked.freqs_hz)),
        )
        cost = np.where(best.left.min(axis=1) > 0, np.sqrt(np.maximum(10 ** (best.cost_db() / 10), 0.0)), 0.0)
        chosen = np.union1d(_marked(grid.freqs_hz, size, _POINTS // 2), _marked(grid.freqs_hz, cost, _POINTS // 2))

        def problem_at(points: _Sampled, ratio: Array | None = None) -> Problem:
            return self._problem(points, grid.freqs_hz, best, ratio)

        # Sound beyond the band, where nothing has to be tight.
        problem = problem_at(grid.some(chosen)).joined(problem_at(checked.some(beyond)))
        found = fit_sections(problem, self.max_order, self.tolerance_db)
        weight = self._weight(found.sections, grid.E.shape[2])
        for _ in range(_ROUNDS):
            bends = self.sampled(np.arctan(np.sqrt(found.sections.bends())) / (np.pi * self.sample_period_s))
            seen = joined(checked.freqs_hz, bends.freqs_hz)[1]
            ratio = np.concatenate([checked.ratio(weight), bends.ratio(weight)], axis=1)[:, seen]
            used = weight.magnitudes(grid.freqs_hz)
            excess = (used.cost_db() - best.cost_db()) - found.excess_db
            if ratio.max() <= _LIFT and not (excess > _MISSED_DB).any():
                break
            _LOG.debug(
                "Weight: exceeded %.3f times, by %.2f dB in cost between the points of the fit",
                ratio.max(),
                excess.max(),
            )
            exceeded, costly = (
                _peaks(ratio.max(axis=0)),
                _peaks(10 ** (np.nan_to_num(excess, nan=0.0, posinf=0.0) / 20)),
            )
            worst = checked.chosen(bends, seen[exceeded])
            problem = problem.joined(problem_at(worst, ratio[:, exceeded])).joined(problem_at(grid.some(costly)))
            found = refit(problem, found.sections)
            weight = self._weight(found.sections, grid.E.shape[2])
        return weight

    def _weight(self, sections: Sections, n_left: int) -> Weight:
        """The systems, not yet checked."""
        systems, orders = sections.systems(self.sample_period_s), tuple(int(n) for n in sections.orders)
        left, right = block_diagonal(systems[:n_left]), block_diagonal(systems[n_left:])
        return Weight(left, right, orders[:n_left], orders[n_left:], Structure.DIAGONAL, np.nan, np.nan)

    def _problem(self, points: _Sampled, grid_hz: Array, best: Cover, ratio: Array | None) -> Problem:
        """Residuals with the cost of the optimal cover from the grid; frequencies where there is nothing to cover are left out."""
        freqs_hz, E = points.freqs_hz, points.E
        known = np.flatnonzero(best.left.min(axis=1) > 0)
        cost = np.log(best.left[known]).mean(axis=1) + np.log(best.right[known]).mean(axis=1)
        optimal = np.where(self.inside(freqs_hz), np.interp(freqs_hz, grid_hz[known], cost), np.inf)
        near = known[np.searchsorted(grid_hz[known], freqs_hz).clip(0, len(known) - 1)]
        ratio = cover_ratio(E, best.left[near], best.right[near]) if ratio is None else ratio
        some = np.abs(E).max(axis=(0, 2, 3), initial=0.0) > 0
        return Problem(
            freqs_hz[some],
            bilinear_squared(freqs_hz[some], self.sample_period_s),
            E[:, some],
            optimal[some],
            ratio[:, some],
        )


def _marked(freqs_hz: Array, size: Array, count: int) -> Array:
    """Indices of both ends, the highest peaks, and points as dense as a size bends, a share of them evenly spaced."""
    inner = np.flatnonzero((size > 0) & (freqs_hz > 0))
    ends = [0, len(freqs_hz) - 1]
    if len(inner) < count:
        return np.unique(np.concatenate([inner, ends]))
    level = np.log(size[inner])
    peaks = np.flatnonzero((level[1:-1] >= level[:-2]) & (level[1:-1] > level[2:])) + 1
    peaks = peaks[np.argsort(-level[peaks])[:_WORST]]
    bend = np.abs(np.gradient(np.gradient(level, np.log(freqs_hz[inner])))) + 1e-12
    share = np.cumsum(bend / bend.sum() + 1 / len(inner)) / 2
    spread = np.interp((np.arange(count) + 0.5) / count, share, np.arange(len(inner))).round().astype(int)
    return np.unique(np.concatenate([inner[peaks], inner[spread], ends]))


def _lifted(weight: Weight, claimed: _Sampled, proof: Certificate) -> Weight:
    """Scale the left weight until it touches the residuals from above, between grid points too, and measure what is returned."""
    if not proof.peak > 0:
        return replace(weight, cover_max=0.0, remaining_margin=1.0)
    bound = proof.peak * (1 + proof.margin) if proof.method is Method.LEVEL_SETS else proof.peak
    lift = bound * (1 + _MARGIN)
    weight = weight.scaled(lift)
    on_grid = float(claimed.ratio(weight).max())
    return replace(weight, cover_max=on_grid, method=proof.method, remaining_margin=1 - max(bound / lift, on_grid))


def _peaks(ratio: Array) -> Array:
    """Indices of the worst local maxima above one."""
    inner = np.concatenate([[-np.inf], ratio, [-np.inf]])
    found = np.flatnonzero((ratio >= inner[:-2]) & (ratio >= inner[2:]) & (ratio > 1))
    return found[np.argsort(-ratio[found])[:_WORST]]
