r"""Weights from residuals: a fit at few frequencies, a check at many, a proof at all.

All magnitudes of a diagonal weight are fitted together (`joint`). The fit is checked on a grid ten times denser, with
DC, Nyquist and the modes of units and weights; frequencies that it misses join it. What counts is the proof
for the systems as returned (`proof`); at last the left weight is scaled until it touches.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ...core import AnyArray, Flags, StateSpace, block_diagonal, frozen, gain
from ...core.frequency import nyquist_hz
from ...core.linalg import pieces
from ..forms import Form, completion, evenly, residual
from ..settings import FIT, PROOF, SET
from .cover import NEPER_DB, Cover, Weight, optimal_cover
from .joint import JointProblem, fit_jointly, refit
from .proof import Certificate, Descriptor, certify, invert, leaves_nothing, residual_system
from .sections import bilinear_squared


def fit_weight(
    residuals: Residuals, freqs_hz: AnyArray, sample_period_s: float, max_order: int, tolerance_db: float
) -> tuple[Weight, Cover]:
    """Return diagonal weights that cover all units at all frequencies, and the optimal cover at `freqs_hz`.

    The tolerance is the overbound at which a lower order of the entries is good enough.
    """
    fit = _Fit(residuals, freqs_hz, sample_period_s)
    weight = fit.start(max_order, tolerance_db)
    proof, ratio = fit.proven(weight)
    for _ in range(FIT.rounds):
        missed = fit.costly(weight)
        if proof.bound > FIT.deficit:
            missed = np.concatenate([missed, fit.checked_hz[_peaks(ratio)], [proof.freq_hz]])
        if not missed.size:
            break
        weight = fit.again(missed)
        proof, ratio = fit.proven(weight)
    cover = fit.optimal.at(np.searchsorted(fit.freqs_hz, freqs_hz))
    on_grid, left = float(ratio.max()), weight.left
    lift = max(proof.bound, on_grid) * (1 + PROOF.rounding) or 1.0  # until the left weight touches from above
    left = replace(left, C=left.C * lift, D=left.D * lift)
    weight, some = replace(weight, left=left, method=proof.method), cover.left.min(axis=1) > 0
    excess = weight.magnitudes(freqs_hz).at(some).cost() - cover.at(some).cost()
    overbound = NEPER_DB * float(excess.max(initial=0.0))
    return replace(weight, cover_max=on_grid / lift, overbound_db_max=overbound), cover


def checking_grid(freqs_hz: AnyArray, sample_period_s: float) -> AnyArray:
    """Return a dense grid from DC to Nyquist: a fit is free to bend wherever nothing is checked."""
    inside, steps = freqs_hz[freqs_hz > 0], np.arange(PROOF.density) / PROOF.density
    between = (inside[:-1, None] * (inside[1:] / inside[:-1])[:, None] ** steps).ravel()
    dense = np.unique(np.concatenate([[0.0], between, freqs_hz, [nyquist_hz(sample_period_s)]]))
    tau = bilinear_squared(dense, sample_period_s)
    inside = tau[(tau > 0) & (tau < np.inf)]
    inner = np.log10(inside) if inside.size else np.zeros(1)
    low, high = inner.min() - PROOF.decades, inner.max() + PROOF.decades
    logs = np.logspace(low, high, 1 + int(PROOF.a_decade * (high - low)))
    return joined(dense, np.arctan(np.sqrt(logs)) / (np.pi * sample_period_s))


def joined(freqs_hz: AnyArray, others_hz: AnyArray) -> AnyArray:
    """Return both in increasing order, without those of the others that are nearly there, or nearly one."""
    others = np.unique(others_hz)
    others = others[np.diff(others, prepend=-1.0) > PROOF.rounding * others]
    at = np.searchsorted(freqs_hz, others)
    below, above = freqs_hz[np.maximum(at - 1, 0)], freqs_hz[np.minimum(at, len(freqs_hz) - 1)]
    near = np.minimum(np.abs(others - below), np.abs(others - above))
    return np.sort(np.concatenate([freqs_hz, others[near > PROOF.rounding * others]]))


class _Fit:
    """One fit, and again with frequencies that it missed."""

    def __init__(self, residuals: Residuals, freqs_hz: AnyArray, dt: float) -> None:
        self.residuals, self.dt, self.band = residuals, dt, freqs_hz[[0, -1]]
        grid = checking_grid(freqs_hz, dt)
        modes = residuals.modes_hz(grid, dt)
        self.checked_hz = joined(grid, modes)
        self.freqs_hz = joined(freqs_hz, modes[self._inside(modes)])
        self.known = residuals.at(self.freqs_hz)
        few = residuals.count * len(self.checked_hz) <= SET.retained
        self.checked = residuals.at(self.checked_hz) if few else None
        self.optimal = optimal_cover(self.known)

    def _inside(self, freqs_hz: AnyArray) -> Flags:
        return (freqs_hz >= self.band[0]) & (freqs_hz <= self.band[1])

    def start(self, max_order: int, tolerance_db: float) -> Weight:
        """Fit at evenly chosen frequencies, and at fewer beyond the band."""
        dt, (p, m) = self.dt, self.known.shape[2:]
        if not self.known.any():
            return Weight(gain(np.zeros((p, p)), dt), gain(np.eye(m), dt), (0,) * p, (0,) * m)
        even = self.freqs_hz[evenly(len(self.freqs_hz), FIT.points)]
        self.problem, near = self._problem(
            np.sort(np.append(even, self.checked_hz[~self._inside(self.checked_hz)][::4]))
        )
        self.fitted = fit_jointly(self.problem, near, max_order, tolerance_db)
        return self._weight()

    def costly(self, weight: Weight) -> AnyArray:
        """Return the frequencies between those of the fit, Hz, at which the weight costs more than at them."""
        if not weight.left.D.any():
            return np.zeros(0)
        cost = NEPER_DB * (weight.magnitudes(self.freqs_hz).cost() - self.optimal.cost()) - self.fitted.excess_db
        return self.freqs_hz[_peaks(10 ** ((np.nan_to_num(cost, posinf=0.0) - FIT.missed_db) / 20))]

    def again(self, missed_hz: AnyArray) -> Weight:
        """Fit again, with the largest residuals at further frequencies."""
        self.problem = self.problem.joined(self._problem(np.unique(missed_hz))[0])
        self.fitted = refit(self.problem, self.fitted.sections)
        return self._weight()

    def proven(self, weight: Weight) -> tuple[Certificate, AnyArray]:
        """Certify a weight for all units; return its largest ratios on the checked grid, too."""

        def ratio(freqs_hz: AnyArray) -> AnyArray:
            return self.residuals.ratio(weight.magnitudes(freqs_hz), freqs_hz)

        E = self.checked
        known = ratio(self.checked_hz) if E is None else weight.magnitudes(self.checked_hz).ratio(E)
        pencils = self.residuals.ratios(weight.left, weight.right) if known.max() > 0 else []
        return certify(ratio, self.checked_hz, known, pencils, weight.left.dt), known.max(axis=0)

    def _weight(self) -> Weight:
        sections, p = self.fitted.sections, self.known.shape[2]
        systems, orders = sections.systems(self.dt), tuple(sections.orders.tolist())
        return Weight(block_diagonal(systems[:p]), block_diagonal(systems[p:]), orders[:p], orders[p:])

    def _problem(self, freqs_hz: AnyArray) -> tuple[JointProblem, Cover]:
        """Return the largest residuals by the optimal cover, with its cost within the band, and the cover."""
        best, E = self.optimal, self.residuals.at(freqs_hz)
        known = np.flatnonzero(best.left.min(axis=1) > 0)
        cover = best.at(known[np.searchsorted(self.freqs_hz[known], freqs_hz).clip(0, len(known) - 1)])
        leading = np.argsort(-cover.ratio(E), axis=0)[: FIT.units]
        some = np.flatnonzero(np.abs(E).max(axis=(0, 2, 3), initial=0.0) > 0)
        cost = np.interp(freqs_hz, self.freqs_hz[known], best.at(known).cost())
        optimal = np.where(self._inside(freqs_hz), cost, np.inf)
        tau = bilinear_squared(freqs_hz, self.dt)
        return JointProblem.of(tau[some], optimal[some], E[leading[:, some], some]), cover.at(some)


def _peaks(ratio: AnyArray) -> AnyArray:
    """Return the indices of the worst local maxima above one."""
    inner = np.concatenate([[-np.inf], ratio, [-np.inf]])
    tops = np.flatnonzero((ratio >= inner[:-2]) & (ratio >= inner[2:]) & (ratio > 1))
    return np.sort(tops[np.argsort(-ratio[tops])[: PROOF.worst]])


@frozen
class Sampled:
    """Responses at some frequencies, which are straight lines between them and constant beyond the ends."""

    freqs_hz: AnyArray
    values: AnyArray  # (..., frequency, p, m)

    def __getitem__(self, rows: Any) -> Sampled:
        """Return those of some units."""
        return Sampled(self.freqs_hz, self.values[rows])

    def frequency_response(self, freqs_hz: AnyArray) -> AnyArray:
        """Return responses at other frequencies."""
        from scipy.interpolate import make_interp_spline

        ends = self.freqs_hz[[0, -1]]
        return make_interp_spline(self.freqs_hz, self.values, k=1, axis=-3)(np.clip(freqs_hz, *ends))


@frozen
class Residuals:
    """Residuals of scaled units against a nominal, or remainders of the form, as functions of frequency, Hz."""

    form: Form
    nominal: StateSpace | Sampled
    units: StateSpace | Sampled
    count: int  # of units
    remainder: bool = False

    def pieces(self, freqs_hz: AnyArray) -> Iterator[tuple[AnyArray, AnyArray]]:
        """Yield responses and residuals, a few units at a time: memory does not grow with their number."""
        G = self.nominal.frequency_response(freqs_hz)
        for part in pieces(self.count, SET.at_once // max(1, len(freqs_hz))):
            Gp = self.units[part].frequency_response(freqs_hz)
            yield Gp, completion(self.form, G, Gp)[1] if self.remainder else residual(self.form, G, Gp)

    def at(self, freqs_hz: AnyArray) -> AnyArray:
        """Return residuals, shape (unit, frequency, p', m')."""
        return np.concatenate([E for _, E in self.pieces(freqs_hz)])

    def ratio(self, cover: Cover, freqs_hz: AnyArray) -> AnyArray:
        """Return the ratios of all units to a cover at the same frequencies, shape (unit, frequency)."""
        return np.concatenate([cover.ratio(E) for _, E in self.pieces(freqs_hz)])

    def ratios(self, left: StateSpace, right: StateSpace) -> list[Descriptor]:
        """Return `W_L^-1 E_k W_R^-1` of systems; none where pencils are large or nothing is left out."""
        systems = self._systems(self.remainder)
        if not systems or (self.remainder and leaves_nothing(self.form, *systems[0].D.shape)):
            return []
        before, after = (Descriptor.of(invert(w)) for w in (right, left))
        parts = [after @ part @ before for part in systems]
        return parts if 2 * len(parts[0].A) + parts[0].B.shape[1] <= PROOF.rows else []

    def modes_hz(self, grid_hz: AnyArray, dt: float) -> AnyArray:
        """Return frequencies of modes of residuals and plants that a grid from DC to Nyquist passes over."""
        parts = (*self._systems(remainder=False), *self._plants())
        modes = np.concatenate([np.zeros(0, complex), *(part.poles() for part in parts)])
        omega = modes.imag[modes.imag > 0]
        half = np.abs(modes.real[modes.imag > 0])
        at_hz, width_hz = np.arctan(omega) / (np.pi * dt), half / (1 + omega**2) / (np.pi * dt)
        narrow = (width_hz < np.interp(at_hz, grid_hz, np.gradient(grid_hz))) & (at_hz <= grid_hz[-1])
        around = omega[narrow] + half[narrow] * np.array([[-1.0], [0.0], [1.0]])
        return np.unique(np.arctan(around[around > 0]) / (np.pi * dt)).clip(max=grid_hz[-1])

    def _plants(self) -> list[Descriptor]:
        """Return the nominal and the units where they are systems."""
        plants = (self.nominal, *(self.units[k] for k in range(self.count)))
        return [Descriptor.of(plant) for plant in plants if isinstance(plant, StateSpace)]

    def _systems(self, remainder: bool) -> list[Descriptor]:
        """Return the systems behind these residuals, or behind what the form does not represent."""
        plants = self._plants()
        return [residual_system(self.form, plants[0], Gp, remainder) for Gp in plants[1:]]
