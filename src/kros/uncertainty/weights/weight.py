r"""Weights: diagonal systems left and right that bound the residuals of all units, at every frequency, as used.

    E_k = W_L Delta_k W_R,   ||Delta_k|| <= 1      w2 ──> W_L ──>   and   ──> W_R ──> z2

All entries of diagonal weights are fitted together (`diagonal`, `joint`), against the cost of the optimal cover, of which no single choice has
to be followed. What counts is the check at the end: on a grid ten times denser with DC and Nyquist, and between its points as far as the
residuals allow (`certificate`), for the systems as returned. Where it fails, the worst frequencies and units join the fit, and at last the left
weight is scaled until it touches.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError
from ...core.frequency import bilinear_squared
from ...core.lti import StateSpace, block_diagonal, gain
from ..fits.chain import diagonal_response
from ..fits.diagonal import Problem, fit_sections, refit
from ..fits.magnitude import fit_magnitude
from ..fits.sections import Sections
from .certificate import Certificate, Method
from .check import Checks, Residuals, joined
from .cover import Cover, Perturbation, Structure, as_structure, cover_ratio, optimal_cover
from .pencils import ResidualSystems

Array = npt.NDArray[Any]

_LOG = logging.getLogger(__name__)
_MARGIN = 1e-9
_LIFT = 1.02  # a deficit up to here is lifted, a larger one refines the grid
_ROUNDS = 4
_WORST = 20  # frequencies added in a round
_POINTS = 160  # of the grid in the joint fit
_MISSED_DB = 0.05  # a cost higher than this between the points of the fit brings further ones
_PROOFS = 2  # fits, each with the frequencies at which the proof found the one before exceeded


@dataclass(frozen=True, eq=False)
class Weight:
    """Stable, minimum-phase diagonal weights that cover a set of residuals.

    Parameters
    ----------
    left : StateSpace
        W_L, p' inputs and outputs.
    right : StateSpace
        W_R, m' inputs and outputs.
    left_orders, right_orders : tuple of int
        Order of every diagonal entry.
    structure : Structure
    cover_max : float
        Largest `sigma_max(W_L^-1 E_k W_R^-1)` over units and the dense grid, for the weights as used; at most one.
    overbound_db_max : float, dB
        Largest excess over the grid of `mean_i log left_i + mean_j log right_j`, by which covers are compared, over the optimal cover.
    within_tolerance : bool
        Whether the overbound of the weight as returned, at every frequency of the grid, is within the tolerance asked for: `overbound_db_max`,
        and of entrywise weights that of every entry.
    overbound_entry_db : float, dB
        Largest fitted over optimal `left_i right_j` over the grid and all (i, j). The optimal cover is rarely unique: a large value beside a
        small `overbound_db_max` says that another cover of nearly the same cost was taken.
    method : Method
        How the bound between grid points is known, see `certificate`.
    remaining_margin : float
        One minus the largest ratio over all frequencies: by level sets a bound on it, on a grid what was found.
    """

    left: StateSpace
    right: StateSpace
    left_orders: tuple[int, ...]
    right_orders: tuple[int, ...]
    structure: Structure
    cover_max: float
    overbound_db_max: float
    within_tolerance: bool = True
    overbound_entry_db: float = float("nan")
    method: Method = Method.GRID
    remaining_margin: float = float("nan")

    @property
    def perturbation(self) -> Perturbation:
        """Perturbations Delta for which the weight is sound: ``full``, or ``diagonal`` alone for entrywise weights."""
        return self.structure.perturbation

    def magnitudes(self, freqs_hz: npt.ArrayLike) -> Cover:
        """Return the magnitudes of the diagonals at some frequencies."""
        return Cover(_diagonal(self.left, freqs_hz), _diagonal(self.right, freqs_hz))

    def matrix(self) -> StateSpace:
        """Return the p' by m' system `W_L 1 W_R`, with 1 a matrix of ones, that bounds every entry of the residuals: `|E_ij| <= |W_ij|`."""
        ones = gain(np.ones((self.left.n_inputs, self.right.n_outputs)), self.left.dt)
        return self.left @ ones @ self.right

    def mapped(self, change: Callable[[StateSpace], StateSpace]) -> Weight:
        """Return the weight with its systems changed, for example to another time."""
        return replace(self, left=change(self.left), right=change(self.right))


def fit_weight(
    residuals: Residuals,
    freqs_hz: Array,
    sample_period_s: float,
    *,
    structure: Structure | str = Structure.DIAGONAL,
    max_order: int = 4,
    tolerance_db: float = 1.0,
    density: int = 10,
    systems: ResidualSystems | None = None,
    poles: npt.ArrayLike | None = None,
    also_hz: npt.ArrayLike | None = None,
    sampled: bool = False,
) -> tuple[Weight, Cover]:
    """Fit weights to residuals that can be evaluated at any frequency.

    Parameters
    ----------
    residuals : callable
        From frequencies (n,), Hz, to residuals of shape (unit, n, p', m'), complex.
    freqs_hz : ndarray, shape (frequency,), Hz
    sample_period_s : float, s
    structure : Structure or str
    max_order : int
        Largest order of an entry, up to about eight.
    tolerance_db : float, dB
        Overbound at which lower orders are good enough: of scalar weights the smallest order within it is taken; of diagonal ones orders start
        at four, are lowered entry by entry while the overbound stays within it, and raised by two in all entries where it does not.
    density : int
        How much denser the grid of the final check is.
    systems : ResidualSystems, optional
        The systems behind the residuals: the bound is then tested at all frequencies, by level sets, and not on a grid alone.
    poles : array_like of complex, optional
        Poles in z that scalar weights must have, see `fit_magnitude`. (Zeros at DC or Nyquist a weight cannot have: it would cover nothing there.)
    also_hz : array_like, shape (n,), Hz, optional
        Where the bound is checked besides, see `peaks_hz`.
    sampled : bool
        The residuals are known at `freqs_hz` only. The bound is claimed there and, as the ends stand for what is beyond them, towards DC and
        Nyquist; between the points the weight is not lifted.

    Returns
    -------
    Weight
    Cover
        The optimal cover at `freqs_hz`, against which the overbound is measured.

    Raises
    ------
    ConfigError
        Poles are given for weights that are not scalar.
    """
    structure = as_structure(structure)
    if poles is not None and structure is not Structure.SCALAR:
        raise ConfigError(f"Weights: poles can be given for scalar weights, found structure {structure.value!r}; leave them out.")
    if structure in (Structure.ENTRYWISE, Structure.FULL):
        from .entrywise import fit_entrywise  # both are made of scalar and diagonal weights
        from .full import fit_full

        fit = fit_entrywise if structure is Structure.ENTRYWISE else fit_full
        options: dict[str, Any] = {"max_order": max_order, "tolerance_db": tolerance_db, "density": density}
        return fit(residuals, freqs_hz, sample_period_s, systems=systems, also_hz=also_hz, sampled=sampled, **options)
    checks = Checks(density, None if also_hz is None else np.asarray(also_hz, float), systems, sampled)
    dense, claimed = checks.grid(freqs_hz, sample_period_s), checks.claimed(freqs_hz, sample_period_s)
    checked = _Checked(dense, residuals(dense))
    fitter = _Fitter(sample_period_s, max_order, tolerance_db, (freqs_hz[0], freqs_hz[-1]))
    of_fit, lowest = checks.of_fit(freqs_hz), 0
    for _ in range(_PROOFS):
        unscaled = _fit(fitter, residuals, of_fit, structure, checked, poles, lowest)
        proof = _proof(unscaled, residuals, checks, claimed)
        found = np.array([proof.freq_hz])
        if proof.peak <= _LIFT * max(1.0, float(checked.ratio(unscaled).max(initial=0.0))):
            break
        checked, of_fit = checked.with_points(found, residuals(found)), joined(of_fit, found)[0]
        lowest = max(max(unscaled.left_orders) - 1, 0)  # further points do not make a lower order better
    weight, best = _finish(unscaled, checked, proof, claimed), optimal_cover(residuals(freqs_hz), structure)
    excess = overbound_db(weight, freqs_hz, best)
    return replace(
        weight,
        overbound_db_max=excess,
        overbound_entry_db=overbound_entry_db(weight, freqs_hz, best),
        within_tolerance=excess <= tolerance_db,
    ), best


@dataclass(frozen=True, eq=False)
class _Checked:
    """Residuals on the dense grid."""

    freqs_hz: Array
    E: Array

    def ratio(self, weight: Weight) -> Array:
        """Largest ratio for every unit and frequency."""
        used = weight.magnitudes(self.freqs_hz)
        return cover_ratio(self.E, used.left, used.right)

    def at(self, freqs_hz: Array) -> _Checked:
        """Return those of some frequencies, and of none beyond them."""
        some = np.isin(self.freqs_hz, freqs_hz)
        return _Checked(self.freqs_hz[some], self.E[:, some])

    def with_points(self, freqs_hz: Array, E: Array) -> _Checked:
        """Return the same with further frequencies."""
        freqs, index = joined(self.freqs_hz, freqs_hz)
        return _Checked(freqs, np.concatenate([self.E, E], axis=1)[:, index])

    def added(self, worst: Array, freqs_hz: Array, E: Array) -> tuple[Array, Array]:
        """Grid and residuals with the worst frequencies in them."""
        freqs, index = joined(freqs_hz, self.freqs_hz[worst])
        return freqs, np.concatenate([E, self.E[:, worst]], axis=1)[:, index]


@dataclass(frozen=True)
class _Fitter:
    """Settings of the fits."""

    sample_period_s: float
    max_order: int
    tolerance_db: float
    band_hz: tuple[float, float]

    def inside(self, freqs_hz: Array) -> Array:
        """Whether frequencies are within the band that was asked for."""
        return (freqs_hz >= self.band_hz[0]) & (freqs_hz <= self.band_hz[1])

    def weight(self, sections: Sections, n_left: int) -> Weight:
        """Return the systems, not yet checked."""
        systems, orders = sections.systems(self.sample_period_s), tuple(int(n) for n in sections.orders)
        left, right = block_diagonal(systems[:n_left]), block_diagonal(systems[n_left:])
        return Weight(left, right, orders[:n_left], orders[n_left:], Structure.DIAGONAL, np.nan, np.nan)


def _fit(
    fitter: _Fitter,
    residuals: Residuals,
    freqs_hz: Array,
    structure: Structure,
    checked: _Checked,
    poles: npt.ArrayLike | None,
    lowest: int,
) -> Weight:
    """Fit diagonal or scalar magnitudes; of one entry, diagonal weights are scalar ones."""
    E = residuals(freqs_hz)
    if structure is Structure.DIAGONAL and E.any() and E.shape[2:] != (1, 1):
        return _fit_diagonal(fitter, residuals, freqs_hz, E, optimal_cover(E), checked)
    return _fit_scalar(fitter, freqs_hz, E, checked, structure, poles, lowest)


def _fit_scalar(
    fitter: _Fitter, freqs_hz: Array, E: Array, checked: _Checked, structure: Structure, poles: npt.ArrayLike | None, lowest: int
) -> Weight:
    """One magnitude for the largest singular values, fitted again with the frequencies at which it is exceeded."""
    dt, p, m = fitter.sample_period_s, E.shape[2], E.shape[3]
    options: dict[str, Any] = {"max_order": fitter.max_order, "tolerance_db": fitter.tolerance_db, "poles": poles}
    for _ in range(_ROUNDS):
        size = optimal_cover(E, Structure.SCALAR).left[:, 0]
        fit = fit_magnitude(freqs_hz, size, dt, min_order=lowest, **options)
        lowest = max(fit.order - 1, 0)
        left = block_diagonal([fit.system] * p)
        weight = Weight(left, gain(np.eye(m), dt), (fit.order,) * p, (0,) * m, structure, np.nan, np.nan)
        ratio = checked.ratio(weight).max(axis=0)
        if ratio.max(initial=0.0) <= _LIFT:
            break
        _LOG.debug("Weight: exceeded %.3f times between grid points, refining the grid", ratio.max())
        freqs_hz, E = checked.added(_peaks(ratio), freqs_hz, E)
    return weight


def _fit_diagonal(fitter: _Fitter, residuals: Residuals, freqs_hz: Array, E: Array, best: Cover, checked: _Checked) -> Weight:
    """Joint fit, and again with the frequencies and units at which it is exceeded or costs more than it should."""
    problem = _problem(fitter, freqs_hz, E, best, checked)
    found = fit_sections(problem, fitter.max_order, fitter.tolerance_db)
    weight = fitter.weight(found.sections, E.shape[2])
    for _ in range(_ROUNDS):
        bends = np.arctan(np.sqrt(found.sections.bends())) / (np.pi * fitter.sample_period_s)
        seen = checked.with_points(bends, residuals(bends))
        ratio, used = seen.ratio(weight), weight.magnitudes(freqs_hz)
        excess = (used.cost_db() - best.cost_db()) - found.excess_db
        if ratio.max() <= _LIFT and not (excess > _MISSED_DB).any():
            break
        _LOG.debug("Weight: exceeded %.3f times, by %.2f dB in cost between the points of the fit", ratio.max(), excess.max())
        exceeded, costly = _peaks(ratio.max(axis=0)), _peaks(10 ** (np.nan_to_num(excess, nan=0.0, posinf=0.0) / 20))
        problem = problem.joined(_problem_at(fitter, seen.freqs_hz[exceeded], seen.E[:, exceeded], freqs_hz, best, ratio[:, exceeded]))
        problem = problem.joined(_problem_at(fitter, freqs_hz[costly], E[:, costly], freqs_hz, best))
        found = refit(problem, found.sections)
        weight = fitter.weight(found.sections, E.shape[2])
    return weight


def _problem(fitter: _Fitter, freqs_hz: Array, E: Array, best: Cover, checked: _Checked) -> Problem:
    """Where the size of the residuals bends and where the cover does; sound beyond the band, where nothing has to be tight."""
    size, beyond = optimal_cover(E, Structure.SCALAR).left[:, 0], np.flatnonzero(~fitter.inside(checked.freqs_hz))
    cost = np.sqrt(np.maximum(10 ** (best.cost_db() / 10), 0.0))
    chosen = np.union1d(
        _telling(freqs_hz, size, _POINTS // 2), _telling(freqs_hz, np.where(best.left.min(axis=1) > 0, cost, 0.0), _POINTS // 2)
    )
    inner = _problem_at(fitter, freqs_hz[chosen], E[:, chosen], freqs_hz, best)
    return inner.joined(_problem_at(fitter, checked.freqs_hz[beyond], checked.E[:, beyond], freqs_hz, best))


def _problem_at(fitter: _Fitter, freqs_hz: Array, E: Array, grid_hz: Array, best: Cover, ratio: Array | None = None) -> Problem:
    """Residuals at some frequencies, with the cost of the optimal cover from the grid; frequencies where there is nothing to cover are left out."""
    known = np.flatnonzero(best.left.min(axis=1) > 0)
    cost = np.log(best.left[known]).mean(axis=1) + np.log(best.right[known]).mean(axis=1)
    optimal = np.where(fitter.inside(freqs_hz), np.interp(freqs_hz, grid_hz[known], cost), np.inf)
    near = known[np.searchsorted(grid_hz[known], freqs_hz).clip(0, len(known) - 1)]
    ratio = cover_ratio(E, best.left[near], best.right[near]) if ratio is None else ratio
    some = np.abs(E).max(axis=(0, 2, 3), initial=0.0) > 0
    return Problem(freqs_hz[some], bilinear_squared(freqs_hz[some], fitter.sample_period_s), E[:, some], optimal[some], ratio[:, some])


def _telling(freqs_hz: Array, size: Array, count: int) -> Array:
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


def overbound_db(weight: Weight, freqs_hz: Array, cover: Cover) -> float:
    """Return the largest excess of the mean log magnitudes over those of the cover, dB; zero where nothing is to be covered."""
    used, some = weight.magnitudes(freqs_hz), cover.left.min(axis=1) > 0
    if not some.any():
        return 0.0
    return float((Cover(used.left[some], used.right[some]).cost_db() - Cover(cover.left[some], cover.right[some]).cost_db()).max())


def overbound_entry_db(weight: Weight, freqs_hz: Array, cover: Cover) -> float:
    """Return the largest fitted over optimal `left_i right_j`, dB; zero where nothing is to be covered."""
    fitted, optimal = weight.magnitudes(freqs_hz).entries(), cover.entries()
    some = optimal > 0
    return float(20 * np.log10(np.max(fitted[some] / optimal[some]))) if some.any() else 0.0


def _proof(weight: Weight, residuals: Residuals, checks: Checks, claimed_hz: Array) -> Certificate:
    """Largest ratio wherever the bound is claimed."""

    def ratio(freqs_hz: Array) -> Array:
        used = weight.magnitudes(freqs_hz)
        return cover_ratio(residuals(freqs_hz), used.left, used.right)

    return checks.proof(ratio, claimed_hz, weight.left, weight.right)


def _finish(weight: Weight, checked: _Checked, proof: Certificate, claimed_hz: Array) -> Weight:
    """Scale the left weight until it touches the residuals from above, between grid points too, and measure what is returned."""
    if not proof.peak > 0:
        return replace(weight, cover_max=0.0, remaining_margin=1.0)
    bound = proof.peak * (1 + proof.margin) if proof.method is Method.LEVEL_SETS else proof.peak
    lift = bound * (1 + _MARGIN)
    weight = scaled(weight, lift)
    on_grid = float(checked.at(claimed_hz).ratio(weight).max())
    return replace(weight, cover_max=on_grid, method=proof.method, remaining_margin=1 - max(bound / lift, on_grid))


def scaled(weight: Weight, factor: float) -> Weight:
    """Return the weight with its left part multiplied."""
    left = weight.left
    return replace(weight, left=StateSpace(left.A, left.B, left.C * factor, left.D * factor, left.dt))


def _peaks(ratio: Array) -> Array:
    """Indices of the worst local maxima above one."""
    inner = np.concatenate([[-np.inf], ratio, [-np.inf]])
    found = np.flatnonzero((ratio >= inner[:-2]) & (ratio >= inner[2:]) & (ratio > 1))
    return found[np.argsort(-ratio[found])[:_WORST]]


def _diagonal(system: StateSpace, freqs_hz: npt.ArrayLike) -> Array:
    """Magnitudes of the diagonal, shape (frequency, size)."""
    return np.abs(diagonal_response(system, freqs_hz))
