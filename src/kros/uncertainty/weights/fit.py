r"""Weights from residuals: a fit at few frequencies, a check at many, a proof at all.

All magnitudes of a diagonal weight are fitted together (`joint`). The fit is checked on a grid ten times denser, with
DC, Nyquist and the modes of units and weights; frequencies and units that it misses join it. What counts is the proof
for the systems as returned (`certificate`); at last the left weight is scaled until it touches.
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
from ..settings import FitSettings
from .certificate import Certificate, Method, certify
from .cover import Cover, cover_ratio, optimal_cover
from .joint import JointFit, JointProblem, fit_jointly, refit
from .residuals import Residuals
from .weight import Weight

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
    settings, dt = target.settings, target.sample_period_s
    few = residuals.of(residuals.deciding(freqs_hz, settings.block))
    grid = checking_grid(freqs_hz, dt, settings.density)
    fit = _Fit(few, freqs_hz, joined(grid, few.modes_hz(grid)), target)
    weight = fit.start()
    for _ in range(settings.rounds):
        missed = fit.missed(weight)
        if not missed.size:
            proof = _proven(residuals, weight, fit.checked_hz, settings.block)
            if proof.bound <= settings.deficit:
                break
            _LOG.debug("Weight: the proof found a ratio of %.4f", proof.bound)
            missed = proof.missed_hz
        weight = fit.again(missed, residuals)
    else:
        proof = _proven(residuals, weight, fit.checked_hz, settings.block)
    cover = _raised(fit.optimal.at(np.searchsorted(fit.freqs_hz, freqs_hz)), residuals, freqs_hz, settings.block)
    return _lifted(weight, proof).measured(freqs_hz, cover, target.tolerance_db), cover


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


class _Fit:
    """One fit, and again with frequencies that it missed, of the units that decide."""

    def __init__(self, residuals: Residuals, freqs_hz: Array, checked_hz: Array, target: Target) -> None:
        self.residuals, self.checked_hz, self.target = residuals, checked_hz, target
        modes = np.setdiff1d(checked_hz, checking_grid(freqs_hz, target.sample_period_s, target.settings.density))
        self.band = freqs_hz[0], freqs_hz[-1]
        self.freqs_hz = joined(freqs_hz, modes[(modes >= self.band[0]) & (modes <= self.band[1])])
        self.shape = residuals.at(freqs_hz).shape[2:]

    @cached_property
    def optimal(self) -> Cover:
        """The optimal cover that the weight follows."""
        return optimal_cover(self.residuals.at(self.freqs_hz))

    def start(self) -> Weight:
        """Fit at evenly chosen frequencies, and at fewer beyond the band."""
        settings, dt, (p, m) = self.target.settings, self.target.sample_period_s, self.shape
        if not self.residuals.at(self.freqs_hz).any():
            sides = gain(np.zeros((p, p)), dt), gain(np.eye(m), dt)
            return Weight(*sides, (0,) * p, (0,) * m, np.nan, np.nan)
        even = np.unique(np.linspace(0, len(self.freqs_hz) - 1, settings.points).round().astype(int))
        beyond = self.checked_hz[(self.checked_hz < self.band[0]) | (self.checked_hz > self.band[1])][::4]
        self.problem, near = self._problem(np.sort(np.append(self.freqs_hz[even], beyond)), self.residuals)
        self.fitted = fit_jointly(self.problem, near, self.target.max_order, self.target.tolerance_db, settings)
        return self._weight(self.fitted)

    def missed(self, weight: Weight) -> Array:
        """Return the frequencies, Hz, at which the weight is exceeded or costs more than it should."""
        if not weight.left.D.any():
            return np.zeros(0)
        settings = self.target.settings
        bends = np.arctan(np.exp(self.fitted.sections.corner / 2)) / (np.pi * self.target.sample_period_s)
        where = joined(self.checked_hz, bends)
        exceeded = _ratio(self.residuals, weight, where).max(axis=0)
        cost = weight.magnitudes(self.freqs_hz).cost_db() - self.optimal.cost_db() - self.fitted.excess_db
        excess = 10 ** ((np.nan_to_num(cost, posinf=0.0) - settings.missed_db) / 20)
        return np.append(where[_peaks(exceeded / settings.deficit)], self.freqs_hz[_peaks(excess)])

    def again(self, missed_hz: Array, everyone: Residuals) -> Weight:
        """Fit again, with the largest residuals of all units at further frequencies."""
        self.problem = self.problem.joined(self._problem(np.unique(missed_hz), everyone)[0])
        self.fitted = refit(self.problem, self.fitted.sections, self.target.settings)
        return self._weight(self.fitted)

    def _weight(self, fitted: JointFit) -> Weight:
        systems, orders = fitted.sections.systems(self.target.sample_period_s), tuple(fitted.sections.orders.tolist())
        p = self.shape[0]
        return Weight(block_diagonal(systems[:p]), block_diagonal(systems[p:]), orders[:p], orders[p:], np.nan, np.nan)

    def _problem(self, freqs_hz: Array, residuals: Residuals) -> tuple[JointProblem, Cover]:
        """Return the largest residuals by the optimal cover, with its cost within the band, and the cover."""
        best, E = self.optimal, residuals.at(freqs_hz)
        known = np.flatnonzero(best.left.min(axis=1) > 0)
        near = known[np.searchsorted(self.freqs_hz[known], freqs_hz).clip(0, len(known) - 1)]
        cover = best.at(near)
        leading = np.argsort(-cover_ratio(E, cover.left, cover.right), axis=0)[: self.target.settings.units]
        some = np.flatnonzero(np.abs(E).max(axis=(0, 2, 3), initial=0.0) > 0)
        cost = np.log(best.left[known]).mean(axis=1) + np.log(best.right[known]).mean(axis=1)
        inside = (freqs_hz >= self.band[0]) & (freqs_hz <= self.band[1])
        optimal = np.where(inside, np.interp(freqs_hz, self.freqs_hz[known], cost), np.inf)
        tau = bilinear_squared(freqs_hz, self.target.sample_period_s)
        return JointProblem.of(tau[some], optimal[some], E[leading[:, some], some]), cover.at(some)


@dataclass(frozen=True)
class _Proof:
    """The certificate with the largest bound over blocks of units, the largest ratio on their grids."""

    certificate: Certificate
    on_grid: float
    missed_hz: Array  # where units are beyond the weight

    @property
    def bound(self) -> float:
        """Largest ratio."""
        return max(self.certificate.bound, self.on_grid)


def _proven(residuals: Residuals, weight: Weight, grid: Array, block: int) -> _Proof:
    """Certify a weight for all units, in blocks, so that memory does not grow with their number."""
    proofs = []
    for rows in residuals.blocks(block):
        some = residuals if len(rows) == len(residuals) else residuals.of(rows)
        claimed = joined(grid, some.modes_hz(grid))
        known = _ratio(some, weight, claimed)

        def ratio(freqs_hz: Array, some: Residuals = some) -> Array:
            return _ratio(some, weight, freqs_hz)

        certificate = certify(ratio, claimed, known, weight.left, weight.right, some.realised if some.proven else None)
        missed = np.append(claimed[_peaks(known.max(axis=0))], certificate.freq_hz)
        proofs.append(_Proof(certificate, float(known.max()), missed))
    worst = max(proofs, key=lambda proof: proof.certificate.bound).certificate
    if any(proof.certificate.method is Method.GRID for proof in proofs):
        worst = replace(worst, method=Method.GRID, peak=worst.bound)
    return _Proof(worst, max(p.on_grid for p in proofs), np.concatenate([p.missed_hz for p in proofs]))


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
    lift, method = proof.bound * (1 + _MARGIN), proof.certificate.method
    if not lift > 0:
        return replace(weight, cover_max=0.0, method=method)
    return replace(weight.scaled(lift), cover_max=proof.on_grid / lift, method=method)


def _peaks(ratio: Array) -> Array:
    """Return the indices of the worst local maxima above one."""
    inner = np.concatenate([[-np.inf], ratio, [-np.inf]])
    tops = np.flatnonzero((ratio >= inner[:-2]) & (ratio >= inner[2:]) & (ratio > 1))
    return np.sort(tops[np.argsort(-ratio[tops])[:_WORST]])
