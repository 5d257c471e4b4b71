r"""Weights: diagonal systems left and right that bound the residuals of all units, at every frequency, as used.

    E_k = W_L Delta_k W_R,   ||Delta_k|| <= 1      w2 ──> W_L ──>   and   ──> W_R ──> z2

One right entry is one (the gauge of `cover`), so that p' + m' - 1 magnitudes are fitted. Diagonal weights start from a cover that is pulled
towards equal entries, smoothed over about an eighth of a decade and fitted entry by entry; then all coefficients move together (`joint`),
against the cost of the optimal cover, of which no single choice has to be followed. Where the excess stays large, other pulls and other
right entries are tried. What counts is the check at the end: on a grid ten times denser with DC and Nyquist, and between its points as far as
the residuals allow (`certificate`), for the systems as returned. Where it fails, the worst frequencies and units join the fit, and at last the
left weight is scaled until it touches.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import KrosError
from ..core.frequency import bilinear_squared, dense_grid
from ..core.lti import StateSpace, block_diagonal, gain
from .certificate import Method, ResidualSystems, certify
from .cover import Cover, Perturbation, Structure, as_structure, cover_ratio, optimal_cover, optimal_left
from .fit import fit_magnitude, rough
from .joint import JointFit
from .spectral import RationalMagnitude, roots, spectral_factor

Array = npt.NDArray[Any]
Residuals = Callable[[Array], Array]

_LOG = logging.getLogger(__name__)
_MARGIN = 1e-9
_LIFT = 1.02  # a deficit up to here is lifted, a larger one refines the grid
_ROUNDS = 4
_WORST = 20  # frequencies added in a round
_SMOOTHING_DECADES = 0.15
_FLOOR = 1e-8  # magnitudes below this fraction of the largest count as this fraction (-160 dB)
_GOOD = 1.5  # no other start is tried below this many tolerances
_PULLS = (0.1, 1.0)
_POINTS = 160  # of the grid in the joint fit
_TAIL = 16  # points towards DC and Nyquist, four a decade
_GUARD = 2000  # points at which it stays positive
_UNITS = 6  # per frequency in the joint fit; the check sees all


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
        Whether the overbound (scalar weights: of every fit) is within the tolerance asked for.
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
        Largest order of a diagonal entry.
    tolerance_db : float, dB
        Overbound at which a lower order is good enough.
    density : int
        How much denser the grid of the final check is.
    systems : ResidualSystems, optional
        The systems behind the residuals: the bound is then tested at all frequencies, by level sets, and not on a grid alone.

    Returns
    -------
    Weight
    Cover
        The optimal cover at `freqs_hz`, against which the overbound is measured.
    """
    structure = as_structure(structure)
    if structure in (Structure.ENTRYWISE, Structure.FULL):
        from .entrywise import fit_entrywise  # both are made of scalar and diagonal weights
        from .full import fit_full

        fit = fit_entrywise if structure is Structure.ENTRYWISE else fit_full
        options: dict[str, Any] = {"max_order": max_order, "tolerance_db": tolerance_db, "density": density}
        return fit(residuals, freqs_hz, sample_period_s, systems=systems, **options)
    E = residuals(freqs_hz)
    best = optimal_cover(E, structure)
    dense = checking_grid(freqs_hz, sample_period_s, density)
    checked = _Checked(dense, residuals(dense))
    fitter = _Fitter(sample_period_s, max_order, tolerance_db, (freqs_hz[0], freqs_hz[-1]))
    together = structure is Structure.DIAGONAL and best.left.any()
    weight = _fit_diagonal(fitter, residuals, checked) if together else _fit_scalar(fitter, freqs_hz, E, checked, structure)
    weight = _finish(weight, residuals, checked, systems)
    excess = overbound_db(weight, freqs_hz, best)
    kept = weight.within_tolerance if structure is Structure.SCALAR else excess <= tolerance_db
    return replace(
        weight, overbound_db_max=excess, overbound_entry_db=overbound_entry_db(weight, freqs_hz, best), within_tolerance=bool(kept)
    ), best


def checking_grid(freqs_hz: Array, sample_period_s: float, density: int) -> Array:
    """Return a dense grid that goes on from its ends to DC and Nyquist, in decades of tau: a fit is free to bend wherever nobody looks."""
    dense = dense_grid(freqs_hz, sample_period_s, density)
    inner = dense[(dense > 0) & (bilinear_squared(dense, sample_period_s) < np.inf)]
    tails = 10.0 ** (np.arange(1, _TAIL + 1) / 4)
    tau = bilinear_squared(inner[[0, -1]], sample_period_s)
    return np.unique(np.concatenate([dense, np.arctan(np.sqrt(np.append(tau[0] / tails**2, tau[1] * tails))) / (np.pi * sample_period_s)]))


@dataclass(frozen=True, eq=False)
class _Checked:
    """Residuals on the dense grid."""

    freqs_hz: Array
    E: Array

    def ratio(self, weight: Weight) -> Array:
        """Largest ratio for every unit and frequency."""
        used = weight.magnitudes(self.freqs_hz)
        return cover_ratio(self.E, used.left, used.right)

    def with_points(self, freqs_hz: Array, E: Array) -> _Checked:
        """Return the same with further frequencies."""
        freqs, index = np.unique(np.concatenate([self.freqs_hz, freqs_hz]), return_index=True)
        return _Checked(freqs, np.concatenate([self.E, E], axis=1)[:, index]) if len(freqs_hz) else self

    def added(self, worst: Array, freqs_hz: Array, E: Array) -> tuple[Array, Array]:
        """Grid and residuals with the worst frequencies in them."""
        freqs, index = np.unique(np.concatenate([freqs_hz, self.freqs_hz[worst]]), return_index=True)
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


def _fit_scalar(fitter: _Fitter, freqs_hz: Array, E: Array, checked: _Checked, structure: Structure) -> Weight:
    """One magnitude for the largest singular values, fitted again with the frequencies at which it is exceeded."""
    dt, p, m = fitter.sample_period_s, E.shape[2], E.shape[3]
    for _ in range(_ROUNDS):
        size = optimal_cover(E, Structure.SCALAR).left[:, 0]
        fit = fit_magnitude(freqs_hz, size, dt, max_order=fitter.max_order, tolerance_db=fitter.tolerance_db)
        left = block_diagonal([fit.system] * p)
        weight = Weight(left, gain(np.eye(m), dt), (fit.order,) * p, (0,) * m, structure, np.nan, np.nan, fit.within_tolerance)
        ratio = checked.ratio(weight).max(axis=0)
        if ratio.max(initial=0.0) <= _LIFT:
            break
        _LOG.debug("Weight: exceeded %.3f times between grid points, refining the grid", ratio.max())
        freqs_hz, E = checked.added(_peaks(ratio), freqs_hz, E)
    return weight


def _fit_diagonal(fitter: _Fitter, residuals: Residuals, checked: _Checked) -> Weight:
    """Joint fit from several starts, and again with the frequencies and units at which it is exceeded."""
    size = optimal_cover(checked.E, Structure.SCALAR).left[:, 0]
    chosen = np.concatenate([np.flatnonzero(~fitter.inside(checked.freqs_hz)), _telling(checked.freqs_hz, size)])
    chosen = np.unique(chosen)
    freqs, some = checked.freqs_hz[chosen], checked.E[:, chosen]
    best = optimal_cover(some)
    units = _leading(cover_ratio(some, best.left, best.right))
    found: _Candidate | None = None
    for start in _starts(fitter, freqs, some[units]):
        candidate = _Candidate.of(start, _joint(freqs, some[units], fitter, checked.freqs_hz))
        if candidate is not None and (found is None or candidate.excess_db < found.excess_db):
            found = candidate
        if found is not None and found.excess_db <= _GOOD * fitter.tolerance_db:
            break
    if found is None:
        raise KrosError("Weights: no fit of the diagonal cover is positive at all frequencies; ask for scalar weights or another order.")
    weight = found.weight(fitter, some.shape[2])
    for _ in range(_ROUNDS):
        bends = found.bends_hz(fitter.sample_period_s)
        seen = checked.with_points(bends, residuals(bends))
        ratio = seen.ratio(weight)
        if ratio.max() <= _LIFT:
            break
        _LOG.debug("Weight: exceeded %.3f times between grid points, refining the grid", ratio.max())
        freqs, some = seen.added(_peaks(ratio.max(axis=0)), freqs, some)
        units = np.union1d(units, _leading(ratio))
        again = _Candidate.of(found.rationals, _joint(freqs, some[units], fitter, seen.freqs_hz))
        if again is None:
            break
        found, weight = again, again.weight(fitter, some.shape[2])
    return weight


def _joint(freqs_hz: Array, E: Array, fitter: _Fitter, guard_hz: Array) -> JointFit:
    """Joint fit where there is something to be covered: tight within the band, sound beyond it."""
    best = optimal_cover(E)
    some = best.left.min(axis=1) > 0
    left = np.maximum(best.left[some], _FLOOR * best.left.max(axis=0))
    optimal = np.log(left).mean(axis=1) + np.log(best.right[some]).mean(axis=1)
    optimal[~fitter.inside(freqs_hz[some])] = np.inf
    guard_hz = np.append(guard_hz[:: max(1, len(guard_hz) // _GUARD)], guard_hz[-1])
    tau, guard = (bilinear_squared(f, fitter.sample_period_s) for f in (freqs_hz[some], guard_hz))
    return JointFit(E[:, some], tau, optimal, guard)


def _telling(freqs_hz: Array, size: Array) -> Array:
    """Indices of both ends, the highest peaks, and points as dense as the size of the residuals bends, a share of them evenly spaced."""
    inner = np.flatnonzero((size > 0) & (freqs_hz > 0))
    ends = [0, len(freqs_hz) - 1]
    if len(inner) < _POINTS:
        return np.unique(np.concatenate([inner, ends]))
    level = np.log(size[inner])
    peaks = np.flatnonzero((level[1:-1] >= level[:-2]) & (level[1:-1] > level[2:])) + 1
    peaks = peaks[np.argsort(-level[peaks])[:_WORST]]
    bend = np.abs(np.gradient(np.gradient(level, np.log(freqs_hz[inner])))) + 1e-12
    share = np.cumsum(bend / bend.sum() + 1 / len(inner)) / 2
    spread = np.interp((np.arange(_POINTS) + 0.5) / _POINTS, share, np.arange(len(inner))).round().astype(int)
    return np.unique(np.concatenate([inner[peaks], inner[spread], ends]))


def _starts(fitter: _Fitter, freqs_hz: Array, E: Array) -> Iterator[list[RationalMagnitude]]:
    """Covers fitted entry by entry, for several pulls and gauges."""
    for pull in _PULLS:
        cover = optimal_cover(E, pull=pull)
        some = cover.left.min(axis=1) > 0
        inside, tau = fitter.inside(freqs_hz[some]), bilinear_squared(freqs_hz[some], fitter.sample_period_s)
        for reference in np.argsort(-np.median(cover.right[some], axis=0), kind="stable")[:2]:
            right = _level(_smoothed(cover.regauged(int(reference)).right[some], freqs_hz[some]), inside)
            left = optimal_left(E[:, some], right, pull)
            left = np.maximum(left, _level(left, inside))
            orders = [fitter.max_order] * left.shape[1] + [0 if j == reference else fitter.max_order for j in range(right.shape[1])]
            start = [rough(tau, values, order) for values, order in zip([*left.T, *right.T], orders, strict=True)]
            if all(r is not None for r in start):
                yield [r for r in start if r is not None]


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Squared magnitudes, left ones first, with their systems."""

    rationals: Sequence[RationalMagnitude]
    excess_db: float
    joint: JointFit = field(repr=False)

    @classmethod
    def of(cls, start: Sequence[RationalMagnitude], joint: JointFit) -> _Candidate | None:
        """Improve a start; None where it is not positive at the frequencies."""
        rationals, excess = joint.fit(start)
        return cls(rationals, excess, joint) if np.isfinite(excess) else None

    def bends_hz(self, sample_period_s: float) -> Array:
        """Frequencies nearest to the poles and zeros: a peak or a notch between grid points is there."""
        found = np.array([t for r in self.rationals for c in (r.numerator, r.denominator) for t in roots(c, r.knots)[0]], complex)
        tau = found[found.real > 0].real
        return np.unique(np.arctan(np.sqrt(tau)) / (np.pi * sample_period_s))

    def weight(self, fitter: _Fitter, n_left: int) -> Weight:
        """Return the systems, not yet checked."""
        dt = fitter.sample_period_s
        systems = [spectral_factor(r, dt) for r in self.rationals]
        orders = tuple(len(r.knots) for r in self.rationals)
        left, right = block_diagonal(systems[:n_left]), block_diagonal(systems[n_left:])
        return Weight(left, right, orders[:n_left], orders[n_left:], Structure.DIAGONAL, np.nan, np.nan)


def _level(values: Array, inside: Array) -> Array:
    """Values within the band, and beyond it the one at its end."""
    band = np.flatnonzero(inside)
    return values[np.clip(np.arange(len(values)), band[0], band[-1])]


def _leading(ratio: Array) -> Array:
    """Indices of the units that are among the largest anywhere."""
    return np.unique(np.argsort(-ratio, axis=0)[:_UNITS])


def _smoothed(values: Array, freqs_hz: Array) -> Array:
    """Gaussian average of log values over log frequency; columns are smoothed one by one."""
    x = np.log10(np.maximum(freqs_hz, freqs_hz[freqs_hz > 0].min(initial=np.inf)))
    kernel = np.exp(-0.5 * ((x[:, None] - x) / _SMOOTHING_DECADES) ** 2) * (np.gradient(x).clip(0.0) if len(x) > 1 else 1.0)
    return np.exp(kernel @ np.log(values) / kernel.sum(axis=1, keepdims=True))


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


def _finish(weight: Weight, residuals: Residuals, checked: _Checked, systems: ResidualSystems | None) -> Weight:
    """Scale the left weight until it touches the residuals from above, between grid points too, and measure what is returned."""
    if not checked.ratio(weight).max(initial=0.0) > 0:
        return replace(weight, cover_max=0.0, remaining_margin=1.0)

    def ratio(freqs_hz: Array) -> Array:
        used = weight.magnitudes(freqs_hz)
        return cover_ratio(residuals(freqs_hz), used.left, used.right)

    proof = certify(ratio, checked.freqs_hz, weight.left, weight.right, systems)
    bound = proof.peak * (1 + proof.margin) if proof.method is Method.LEVEL_SETS else proof.peak
    lift = bound * (1 + _MARGIN)
    weight = scaled(weight, lift)
    on_grid = float(checked.ratio(weight).max())
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
    """Magnitudes of the diagonal, shape (frequency, size), block by block."""
    return np.abs(np.einsum("fii->fi", system.frequency_response(freqs_hz)))
