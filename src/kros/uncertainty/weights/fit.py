r"""Weights from residuals: a fit on few frequencies and units, a check on many, a proof on all.

Magnitudes of one entry are fitted by linear programs (`magnitude`), those of diagonal weights jointly (`joint`); the
paper's entrywise weights are one magnitude for every entry. A fit is checked on a grid ten times denser, with DC,
Nyquist and the modes of units and weights; frequencies and units that it misses join it. What counts is the proof for
the systems as returned (`certificate`): units and frequencies beyond them join once more, and at last the left weight
is scaled until it touches.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.frequency import bilinear_squared, dense_grid
from ...core.lti import block_diagonal, gain
from ...core.small_matrices import sigma_max
from ..settings import FitSettings
from .certificate import Certificate, Method, certify
from .cover import Cover, Structure, cover_ratio, optimal_cover
from .joint import JointFit, JointProblem, fit_jointly, refit
from .magnitude import fit_magnitude
from .residuals import Residuals
from .weight import EntrywiseWeight, Weight, unstructured_excess

Array = npt.NDArray[Any]

_LOG = logging.getLogger(__name__)
_MARGIN = 1e-9  # rounding of ratios
_SAME = 1e-9  # relative distance of frequencies that are one: rounding
_DECADES, _A_DECADE, _EVEN = 4, 15, 101  # of tau beyond the grid, points of the check in each, and evenly over Hz
_WORST = 20  # frequencies that join in a round


@dataclass(frozen=True)
class Target:
    """What a weight should be like: time of its systems, largest order of an entry, overbound that is good enough."""

    sample_period_s: float
    max_order: int = 4
    tolerance_db: float = 1.0
    settings: FitSettings = field(default_factory=FitSettings)


def fit_weight(residuals: Residuals, freqs_hz: Array, target: Target) -> tuple[Weight, Cover]:
    """Return diagonal weights that cover all units at all frequencies, and the optimal cover at `freqs_hz`."""
    settings, block = target.settings, target.settings.block
    grid = checking_grid(freqs_hz, target.sample_period_s, settings.density)
    rows = np.arange(len(residuals)) if len(residuals) <= block else residuals.deciding(freqs_hz, block)
    further = np.zeros(0)
    for _ in range(settings.rounds):
        few = residuals if len(rows) == len(residuals) else residuals.of(rows)
        checked = joined(grid, np.append(few.modes_hz(grid), further))
        fit = _Fit(few, joined(freqs_hz, _inside(checked, freqs_hz, grid)), checked, freqs_hz, target)
        proof = _proven(residuals if len(few) < len(residuals) else few, fit.weight, checked, block)
        missed = np.setdiff1d(proof.beyond, rows)
        if not missed.size and proof.certificate.peak <= settings.deficit * max(
            1.0, fit.ratio(fit.weight).max(initial=0.0)
        ):
            break
        _LOG.debug("Weight: the proof found a ratio of %.4f; %d units join", proof.certificate.peak, len(missed))
        rows, further = np.union1d(rows, missed), np.append(further, proof.certificate.freq_hz)
    cover = _raised(optimal_cover(few.at(freqs_hz)), residuals, freqs_hz, block)
    return _lifted(fit.weight, proof).measured(freqs_hz, cover, target.tolerance_db), cover


def fit_entries(residuals: Residuals, freqs_hz: Array, target: Target) -> tuple[EntrywiseWeight, Cover]:
    """Return one magnitude for every entry, as the paper has it."""
    E = residuals.at(freqs_hz)
    p, m = E.shape[2:]
    dt = target.sample_period_s
    fits = [fit_weight(replace(residuals, entry=entry), freqs_hz, target)[0] for entry in np.ndindex(p, m)]
    sizes = np.abs(E).max(axis=0).reshape(len(freqs_hz), p * m)
    fitted, some = np.hstack([w.magnitudes(freqs_hz).left for w in fits]), sizes.min(axis=1) > 0
    rows, columns = np.kron(np.eye(p), np.ones((1, m))), np.tile(np.eye(m), (p, 1))
    weight = EntrywiseWeight(
        left=gain(rows, dt),
        right=block_diagonal([w.left for w in fits]) @ gain(columns, dt),
        left_orders=(0,) * (p * m),
        right_orders=tuple(w.left_orders[0] for w in fits),
        structure=Structure.ENTRYWISE,
        cover_max=max(w.cover_max for w in fits),
        overbound_db_max=float((20 * np.log10(fitted[some] / sizes[some])).mean(axis=1).max(initial=0.0)),
        within_tolerance=all(w.within_tolerance for w in fits),
        method=Method.LEVEL_SETS if all(w.method is Method.LEVEL_SETS for w in fits) else Method.GRID,
        remaining_margin=min(w.remaining_margin for w in fits),
    )
    dense = checking_grid(freqs_hz, dt, target.settings.density)
    excess = unstructured_excess(weight.matrix().frequency_response(dense), residuals.at(dense))
    return replace(weight, unstructured_excess=excess), Cover(np.ones_like(sizes), sizes)


def checking_grid(freqs_hz: Array, sample_period_s: float, density: int) -> Array:
    """Return a dense grid from DC to Nyquist: a fit is free to bend wherever nothing is checked."""
    dense = dense_grid(freqs_hz, sample_period_s, density)
    tau = bilinear_squared(dense, sample_period_s)
    inner = np.log10(tau[(tau > 0) & (tau < np.inf)]) if ((tau > 0) & (tau < np.inf)).any() else np.zeros(1)
    low, high = inner.min() - _DECADES, inner.max() + _DECADES
    logs = np.logspace(low, high, 1 + int(_A_DECADE * (high - low)))
    even = np.linspace(0.0, dense[-1], _EVEN)
    return joined(dense, np.append(np.arctan(np.sqrt(logs)) / (np.pi * sample_period_s), even))


def joined(freqs_hz: Array, others_hz: Array) -> Array:
    """Return both in increasing order, without those of the others that are nearly there."""
    others = np.unique(others_hz)
    at = np.searchsorted(freqs_hz, others)
    below, above = freqs_hz[np.maximum(at - 1, 0)], freqs_hz[np.minimum(at, len(freqs_hz) - 1)]
    near = np.minimum(np.abs(others - below), np.abs(others - above))
    return np.sort(np.concatenate([freqs_hz, others[near > _SAME * others]]))


def _inside(checked: Array, freqs_hz: Array, grid: Array) -> Array:
    """Return the checked frequencies within the band that are no points of the grid: modes, and what a proof found."""
    modes = np.setdiff1d(checked, grid)
    return modes[(modes >= freqs_hz[0]) & (modes <= freqs_hz[-1])]


@dataclass(frozen=True, eq=False)
class _Fit:
    """One fit: residuals of some units, frequencies that it follows and that it is checked at, the band asked for."""

    residuals: Residuals
    freqs_hz: Array
    checked_hz: Array
    band_hz: Array
    target: Target

    @cached_property
    def weight(self) -> Weight:
        """The systems, not yet proven."""
        E, dt = self.residuals.at(self.freqs_hz), self.target.sample_period_s
        if not E.any():
            sides = gain(np.zeros((E.shape[2],) * 2), dt), gain(np.eye(E.shape[3]), dt)
            return Weight(*sides, (0,) * E.shape[2], (0,) * E.shape[3], Structure.DIAGONAL, np.nan, np.nan)
        return self._single() if E.shape[2:] == (1, 1) else self._diagonal()

    def ratio(self, weight: Weight) -> Array:
        """Return the largest ratio of every checked frequency."""
        return _ratio(self.residuals, weight, self.checked_hz).max(axis=0)

    def _single(self) -> Weight:
        """One magnitude for the largest residuals, fitted again with the frequencies at which it is exceeded."""
        dt, freqs = self.target.sample_period_s, self.freqs_hz
        for _ in range(self.target.settings.rounds):
            size = sigma_max(self.residuals.at(freqs)).max(axis=0)
            fit = fit_magnitude(freqs, size, dt, max_order=self.target.max_order, tolerance_db=self.target.tolerance_db)
            weight = Weight(fit.system, gain([[1.0]], dt), (fit.order,), (0,), Structure.DIAGONAL, np.nan, np.nan)
            ratio = self.ratio(weight)
            if ratio.max() <= self.target.settings.deficit:
                break
            freqs = joined(freqs, self.checked_hz[_peaks(ratio)])
        return weight

    def _diagonal(self) -> Weight:
        """Joint fit, and again with the frequencies and units at which it is exceeded or costs more than it should."""
        settings, dt = self.target.settings, self.target.sample_period_s
        best, grid = self._optimal, self.freqs_hz
        size, cost = sigma_max(self.residuals.at(grid)).max(axis=0), 10 ** (best.cost_db() / 20)
        half = settings.points // 2
        chosen = np.union1d(_marked(grid, size, half), _marked(grid, np.where(np.isfinite(cost), cost, 0.0), half))
        outside = (self.checked_hz < self.band_hz[0]) | (self.checked_hz > self.band_hz[-1])
        beyond = self.checked_hz[outside][::4]
        problem = self._problem(np.sort(np.append(grid[chosen], beyond)), settings.units)
        fitted = fit_jointly(problem, self.target.max_order, self.target.tolerance_db, settings)
        for _ in range(settings.rounds):
            weight = self._systems(fitted)
            bends = np.arctan(np.exp(fitted.sections.corner / 2)) / (np.pi * dt)
            where = joined(self.checked_hz, bends)
            exceeded = _ratio(self.residuals, weight, where).max(axis=0)
            excess = np.nan_to_num(weight.magnitudes(grid).cost_db() - best.cost_db() - fitted.excess_db, posinf=0.0)
            if exceeded.max() <= settings.deficit and not (excess > settings.missed_db).any():
                break
            _LOG.debug("Weight: exceeded %.3f times, by %.2f dB in cost between points", exceeded.max(), excess.max())
            problem = problem.joined(self._problem(where[_peaks(exceeded)], 1, weight))
            problem = problem.joined(self._problem(grid[_peaks(10 ** (excess / 20))], settings.units))
            fitted = refit(problem, fitted.sections, settings)
        return self._systems(fitted)

    @cached_property
    def _optimal(self) -> Cover:
        return optimal_cover(self.residuals.at(self.freqs_hz))

    def _systems(self, fitted: JointFit) -> Weight:
        systems, orders = fitted.sections.systems(self.target.sample_period_s), tuple(fitted.sections.orders.tolist())
        p = self.residuals.at(self.freqs_hz).shape[2]
        sides = block_diagonal(systems[:p]), block_diagonal(systems[p:])
        return Weight(*sides, orders[:p], orders[p:], Structure.DIAGONAL, np.nan, np.nan)

    def _problem(self, freqs_hz: Array, units: int, weight: Weight | None = None) -> JointProblem:
        """Return the largest residuals by the optimal cover, or by a weight, with the optimal cost within the band."""
        grid, best, E = self.freqs_hz, self._optimal, self.residuals.at(freqs_hz)
        known = np.flatnonzero(best.left.min(axis=1) > 0)
        near = known[np.searchsorted(grid[known], freqs_hz).clip(0, len(known) - 1)]
        cover = best.at(near) if weight is None else weight.magnitudes(freqs_hz)
        ratio = cover_ratio(E, cover.left, cover.right)
        leading = np.argsort(-ratio, axis=0)[:units]
        some = np.flatnonzero(np.abs(E).max(axis=(0, 2, 3), initial=0.0) > 0)
        cost = np.log(best.left[known]).mean(axis=1) + np.log(best.right[known]).mean(axis=1)
        inside = (freqs_hz >= self.band_hz[0]) & (freqs_hz <= self.band_hz[-1])
        optimal = np.where(inside, np.interp(freqs_hz, grid[known], cost), np.inf)
        tau = bilinear_squared(freqs_hz, self.target.sample_period_s)
        return JointProblem.of(tau[some], optimal[some], E[leading[:, some], some])


@dataclass(frozen=True)
class _Proof:
    """The certificate with the largest bound over blocks of units, the largest ratio on their grids."""

    certificate: Certificate
    on_grid: float
    beyond: Array


def _proven(residuals: Residuals, weight: Weight, grid: Array, block: int) -> _Proof:
    """Certify a weight for all units, in blocks, so that memory does not grow with their number."""
    proofs = []
    for rows in residuals.blocks(block):
        some = residuals if len(rows) == len(residuals) else residuals.of(rows)
        claimed = grid if some is residuals else joined(grid, some.modes_hz(grid))
        known = _ratio(some, weight, claimed)

        def ratio(freqs_hz: Array, some: Residuals = some) -> Array:
            return _ratio(some, weight, freqs_hz)

        systems = some.realised if some.proven else None
        certificate = certify(ratio, claimed, known, weight.left, weight.right, systems)
        beyond = known.argmax(axis=0)[known.max(axis=0) > 1]
        if certificate.bound > 1:
            beyond = np.append(beyond, ratio(np.array([certificate.freq_hz])).argmax())
        proofs.append(_Proof(certificate, float(known.max()), np.unique(rows[beyond])))
    worst = max(proofs, key=lambda proof: proof.certificate.bound).certificate
    if any(proof.certificate.method is Method.GRID for proof in proofs):
        worst = replace(worst, method=Method.GRID, peak=worst.bound)
    return _Proof(worst, max(p.on_grid for p in proofs), np.unique(np.concatenate([p.beyond for p in proofs])))


def _ratio(residuals: Residuals, weight: Weight, freqs_hz: Array) -> Array:
    """Return `sigma_max(W_L^-1 E_k W_R^-1)`, shape (unit, frequency)."""
    used = weight.magnitudes(freqs_hz)
    return cover_ratio(residuals.at(freqs_hz), used.left, used.right)


def _raised(cover: Cover, residuals: Residuals, freqs_hz: Array, block: int) -> Cover:
    """Return a cover raised at the frequencies at which units of a large population are beyond it."""
    if len(residuals) <= block:
        return cover
    ratios = (residuals.of(rows).at(freqs_hz) for rows in residuals.blocks(block))
    largest = np.max([cover_ratio(E, cover.left, cover.right).max(axis=0) for E in ratios], axis=0)
    return Cover(cover.left * np.maximum(largest, 1.0)[:, None], cover.right)


def _lifted(weight: Weight, proof: _Proof) -> Weight:
    """Scale the left weight until it touches the residuals from above."""
    bound = max(proof.certificate.bound, proof.on_grid)
    if not bound > 0:
        return replace(weight, cover_max=0.0, method=proof.certificate.method, remaining_margin=1.0)
    lift = bound * (1 + _MARGIN)
    scaled, margin = weight.scaled(lift), 1 - bound / lift
    return replace(scaled, cover_max=proof.on_grid / lift, method=proof.certificate.method, remaining_margin=margin)


def _marked(freqs_hz: Array, size: Array, count: int) -> Array:
    """Return the indices of both ends, the highest peaks, and points as dense as a size bends."""
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


def _peaks(ratio: Array) -> Array:
    """Return the indices of the worst local maxima above one."""
    inner = np.concatenate([[-np.inf], ratio, [-np.inf]])
    tops = np.flatnonzero((ratio >= inner[:-2]) & (ratio >= inner[2:]) & (ratio > 1))
    return np.sort(tops[np.argsort(-ratio[tops])[:_WORST]])
