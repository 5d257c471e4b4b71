r"""Weights from residuals: a fit at the frequencies given, a check at many, a proof at all.

All magnitudes of a diagonal weight are fitted together (`joint`): the orders and a first fit at some of the frequencies
given, then once more at all, and at modes of units and residuals that these pass over. Which frequencies take part does
not depend on the fit, so that weights follow the residuals continuously. What counts is the proof for the systems as
returned (`proof`), beside a grid ten times denser with DC and Nyquist; at last the left weight is scaled until it
touches.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ...core import AnyArray, DataError, Flags, StateSpace, block_diagonal, frozen, gain
from ...core.frequency import nyquist_hz
from ...core.linalg import pieces
from ..forms import Form, completion, evenly, residual
from ..settings import FIT, PROOF, SET
from .cover import NEPER_DB, Cover, Weight, optimal_cover
from .joint import JointProblem, fit_jointly, refit
from .proof import Certificate, Descriptor, certify, invert, leaves_nothing, residual_system
from .sections import Sections, bilinear_squared


def fit_weight(
    residuals: Residuals, freqs_hz: AnyArray, sample_period_s: float, max_order: int, tolerance_db: float
) -> tuple[Weight, Cover]:
    """Return diagonal weights that cover all units at all frequencies, and the optimal cover at `freqs_hz`.

    The tolerance is the overbound at which a lower order of the entries is good enough.
    """
    fit = _Fit(residuals, freqs_hz, sample_period_s)
    cover = fit.optimal.at(np.searchsorted(fit.freqs_hz, freqs_hz))
    p, m = cover.left.shape[1], cover.right.shape[1]
    if not fit.tight_hz.size:
        if any(E.any() for _, E in residuals.pieces(fit.checked_hz)):
            alike = f"units are alike at all {len(freqs_hz)} frequencies given, and differ elsewhere"
            raise DataError(f"Weights: {alike}; give frequencies at which they differ.")
        nothing = gain(np.zeros((p, p)), sample_period_s), gain(np.eye(m), sample_period_s)
        return Weight(*nothing, (0,) * p, (0,) * m, 0.0, 0.0), cover
    few = fit.few_hz()
    problem, near = fit.problem(few)
    fitted = fit_jointly(problem, near, max_order, tolerance_db)
    every, _ = fit.problem(np.union1d(few, fit.freqs_hz))
    weight = fit.weight(refit(every, fitted.sections, FIT.last_temperatures).sections)
    proof, ratio = fit.proven(weight)
    on_grid, left = float(ratio.max()), weight.left
    lift = max(proof.bound, on_grid) * (1 + PROOF.rounding)  # until the left weight touches from above
    left = replace(left, C=left.C * lift, D=left.D * lift)
    weight, some = replace(weight, left=left, method=proof.method), cover.left.min(axis=1) > 0
    excess = weight.magnitudes(freqs_hz).at(some).cost() - cover.at(some).cost()
    overbound = NEPER_DB * float(excess.max(initial=0.0))
    return replace(weight, cover_max=on_grid / lift, overbound_db_max=overbound), cover


def checking_grid(freqs_hz: AnyArray, sample_period_s: float) -> AnyArray:
    """Return a dense grid from DC to Nyquist: a fit is free to bend wherever nothing is checked."""
    rows = np.arange(len(freqs_hz))
    between = np.interp(np.arange(PROOF.density * len(rows)) / PROOF.density, rows, freqs_hz)
    tau = bilinear_squared(freqs_hz, sample_period_s)
    logs = np.log10(tau[(tau > 0) & (tau < np.inf)])
    low, high = logs.min(initial=0.0) - PROOF.decades, logs.max(initial=0.0) + PROOF.decades
    everywhere = np.logspace(low, high, 1 + int(PROOF.a_decade * (high - low)))
    ends = [0.0, nyquist_hz(sample_period_s)]
    return np.unique(
        np.concatenate([ends, freqs_hz, between, np.arctan(np.sqrt(everywhere)) / (np.pi * sample_period_s)])
    )


class _Fit:
    """Residuals on the grids of a fit and of its check, and their optimal cover."""

    def __init__(self, residuals: Residuals, freqs_hz: AnyArray, dt: float) -> None:
        self.residuals, self.dt, self.band = residuals, dt, freqs_hz[[0, -1]]
        grid = checking_grid(freqs_hz, dt)
        modes = residuals.modes_hz(freqs_hz, dt)
        self.checked_hz = np.union1d(grid, modes)
        self.freqs_hz = np.union1d(freqs_hz, modes[self._inside(modes)])
        few = residuals.count * len(self.checked_hz) <= SET.retained
        self.checked = residuals.at(self.checked_hz) if few else None
        self.optimal = optimal_cover(residuals.at(self.freqs_hz))
        some = self.optimal.left.min(axis=1) > 0
        self.tight_hz, self.tight = self.freqs_hz[some], self.optimal.at(some)

    def _inside(self, freqs_hz: AnyArray) -> Flags:
        return (freqs_hz >= self.band[0]) & (freqs_hz <= self.band[1])

    def few_hz(self) -> AnyArray:
        """Return evenly chosen frequencies, and fewer beyond the band."""
        even = self.freqs_hz[evenly(len(self.freqs_hz), FIT.points)]
        return np.union1d(even, self.checked_hz[~self._inside(self.checked_hz)][::4])

    def problem(self, freqs_hz: AnyArray) -> tuple[JointProblem, Cover]:
        """Return the largest residuals by the optimal cover, with its cost within the band, and the cover."""
        E = self.residuals.at(freqs_hz)
        some = E.any(axis=(0, 2, 3))
        E, freqs = E[:, some], freqs_hz[some]
        cover = self.tight.at(np.searchsorted(self.tight_hz, freqs).clip(max=len(self.tight_hz) - 1))
        leading = np.argsort(-cover.ratio(E), axis=0)[: FIT.units]
        cost = np.interp(freqs, self.tight_hz, self.tight.cost())
        optimal = np.where(self._inside(freqs), cost, np.inf)
        tau = bilinear_squared(freqs, self.dt)
        return JointProblem(tau, optimal, E[leading, np.arange(len(freqs))]), cover

    def weight(self, sections: Sections) -> Weight:
        """Return the systems of magnitudes, left ones first."""
        systems, orders, p = sections.systems(self.dt), tuple(sections.orders.tolist()), self.tight.left.shape[1]
        return Weight(block_diagonal(systems[:p]), block_diagonal(systems[p:]), orders[:p], orders[p:])

    def proven(self, weight: Weight) -> tuple[Certificate, AnyArray]:
        """Certify a weight for all units; return its largest ratios on the checked grid, too."""

        def ratio(freqs_hz: AnyArray) -> AnyArray:
            return self.residuals.ratio(weight.magnitudes(freqs_hz), freqs_hz)

        E = self.checked
        known = ratio(self.checked_hz) if E is None else weight.magnitudes(self.checked_hz).ratio(E)
        pencils = self.residuals.ratios(weight.left, weight.right)
        return certify(ratio, self.checked_hz, known, pencils, self.dt), known.max(axis=0)


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

    def modes_hz(self, freqs_hz: AnyArray, dt: float) -> AnyArray:
        """Return frequencies of modes of residuals and plants that a grid passes over, and half a width beside."""
        grid = np.unique(np.concatenate([[0.0], freqs_hz, [nyquist_hz(dt)]]))
        parts = (*self._systems(remainder=False), *self._plants())
        modes = np.concatenate([np.zeros(0, complex), *(part.poles() for part in parts)])
        omega, half = modes.imag[modes.imag > 0], np.abs(modes.real[modes.imag > 0])
        at = np.arctan(omega + half * np.array([[-1.0], [0.0], [1.0]])) / (np.pi * dt)
        width = half / (1 + omega**2) / (np.pi * dt)
        at = at[:, width < np.interp(at[1], grid, np.gradient(grid))]
        return np.unique(at[at > 0])

    def _plants(self) -> list[Descriptor]:
        """Return the nominal and the units where they are systems."""
        plants = (self.nominal, *(self.units[k] for k in range(self.count)))
        return [Descriptor.of(plant) for plant in plants if isinstance(plant, StateSpace)]

    def _systems(self, remainder: bool) -> list[Descriptor]:
        """Return the systems behind these residuals, or behind what the form does not represent."""
        plants = self._plants()
        return [residual_system(self.form, plants[0], Gp, remainder) for Gp in plants[1:]]
