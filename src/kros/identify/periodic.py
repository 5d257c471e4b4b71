"""A ratio of gears, or gravity, seen in recordings: what a linear model of one step leaves, against an angle.

Symbols
-------
e_k   : residual of ``x_{k+1}`` regressed on the states and inputs of the last steps, each unit by itself
q_k   : angle, rad
P(r)  : ``2 |sum_k e_k exp(-i r q_k)|^2 / (N sum_k e_k^2)``, about the share of the residual that ``sin(r q)`` and
        ``cos(r q)`` explain, for all r by a histogram of the residual over the angle and one FFT
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.rounding import TINY
from ..data.population import EpisodeKey, Population

Array = npt.NDArray[np.float64]
_BINS = 1 << 21  # of the histogram, at most


@dataclass(frozen=True)
class PeriodicTerm:
    """A term of an angle that a linear model lacks: its share of the residual, and how far its peak stands out."""

    angle: str
    ratio: float
    share: float
    above: float
    odd: bool = False


@dataclass(frozen=True)
class PeriodicTest:
    """When a term counts as seen."""

    largest_ratio: float = 500.0  # beyond that of any gear
    lags: int = 3  # steps whose states and inputs the residual is regressed on
    samples: int = 40_000  # of a unit
    around: tuple[float, float] = (6.0, 40.0)  # surroundings of a peak, in its half widths
    above: float = 15.0  # of a peak over the median around it; noise alone reaches about 8
    above_in_every_unit: float = 3.0  # of the peak of each unit over its surroundings
    least_share: float = 0.002  # of the residual that a term explains
    gravity: float = 0.01  # the same for sin(angle), which other smooth terms resemble
    least_travel: float = 0.5  # rad, that sin(angle) needs
    odd: float = 0.9  # of what sine and cosine explain, that the sine alone explains where a term is odd
    whole: float = 0.8  # of what the best ratio explains, that a whole number near it has to explain to be taken


@dataclass(frozen=True, eq=False)
class _Unit:
    """Residuals of one step (n, n_states), the angle before it (n,), an orthonormal basis of the regressors (n, p)."""

    residuals: Array
    angle: Array
    basis: Array

    @classmethod
    def of(cls, episodes: Sequence[Array], column: int, n_states: int, test: PeriodicTest) -> _Unit:
        scale = np.maximum(np.max([np.abs(v).max(axis=0) for v in episodes], axis=0), TINY)
        lags, rows, targets, angles, left = test.lags, [], [], [], test.samples
        for values in episodes:
            x, n = values[:left] / scale, min(left, len(values)) - test.lags
            if n < 1:
                continue
            past = [x[lags - 1 - lag : lags - 1 - lag + n] for lag in range(lags)]
            rows.append(np.hstack([*past, x[lags:, n_states:], np.ones((n, 1))]))
            targets.append(x[lags:, :n_states])
            angles.append(values[lags - 1 : lags - 1 + n, column])
            left = max(left - len(x), 0)
        u, s, _ = np.linalg.svd(np.vstack(rows), full_matrices=False)
        basis, y = u[:, s > 1e-10 * s[0]], np.vstack(targets)
        return cls(y - basis @ (basis.T @ y), np.concatenate(angles), basis)

    @property
    def travel(self) -> float:
        """Range of the angle, rad."""
        return float(np.ptp(self.angle))

    def share(self, ratios: Sequence[float], functions: Sequence[np.ufunc] = (np.sin, np.cos)) -> float:
        """Return the share of the residual that functions explain beside the regressors, the largest of the states."""
        columns = np.stack([f(r * self.angle) for r in ratios for f in functions], axis=1)
        columns -= self.basis @ (self.basis.T @ columns)
        u, s, _ = np.linalg.svd(columns, full_matrices=False)
        u = u[:, s > 1e-8 * np.sqrt(len(self.angle))]
        energy = np.maximum(np.sum(self.residuals**2, axis=0), TINY)
        return float(np.max(np.sum((u.T @ self.residuals) ** 2, axis=0) / energy, initial=0.0))

    def spectrum(self, low: float, cell: float, n_bins: int) -> Array:
        """Return P(r), the largest over the states, shape (n_bins // 2 + 1,)."""
        place = ((self.angle - low) / cell).astype(np.int64)
        power = np.zeros(n_bins // 2 + 1)
        for e in self.residuals.T:
            energy = float(e @ e)
            if energy > 0:
                line = np.abs(np.fft.rfft(np.bincount(place, weights=e, minlength=n_bins))) ** 2
                power = np.maximum(power, 2 * line / (len(e) * energy))
        return power


def periodic_term(population: Population, angles: Sequence[str], keys: Sequence[EpisodeKey]) -> PeriodicTerm | None:
    """Return the periodic term that shows most in some episodes, or None where none does."""
    test = PeriodicTest()
    recordings = [[population.read(k) for k in keys if k.unit == unit] for unit in dict.fromkeys(k.unit for k in keys)]
    names, n = population.states + population.inputs, len(population.states)
    terms = []
    for angle in angles:
        units = [_Unit.of(episodes, names.index(angle), n, test) for episodes in recordings]
        units = [unit for unit in units if len(unit.angle) > 20 * test.lags * unit.basis.shape[1]]
        terms += [term for term in [_term(units, angle, test)] if term is not None] if units else []
    return max(terms, key=lambda term: term.share, default=None)


def _term(units: Sequence[_Unit], name: str, test: PeriodicTest) -> PeriodicTerm | None:
    peak = _peak(units, test)
    if peak is not None and (share := max(unit.share([peak[0]]) for unit in units)) > test.least_share:
        return PeriodicTerm(name, _refined(units, peak[0], test), share, peak[1])
    shares = [unit.share([1.0]) for unit in units]
    if min(shares) < test.gravity or max(unit.travel for unit in units) < test.least_travel:
        return None
    odd = np.mean([unit.share([1.0], (np.sin,)) for unit in units]) > test.odd * np.mean(shares)
    return PeriodicTerm(name, 1.0, float(np.mean(shares)), np.inf, bool(odd))


def _peak(units: Sequence[_Unit], test: PeriodicTest) -> tuple[float, float] | None:
    """Return the ratio of the fundamental, and how far its peak stands out."""
    low, travel = min(unit.angle.min() for unit in units), max(unit.travel for unit in units)
    width = max(unit.angle.max() for unit in units) - low
    advance = max(float(np.quantile(np.abs(np.diff(unit.angle)), 0.9)) for unit in units)
    if min(width, travel, advance) <= 0:
        return None
    largest = min(test.largest_ratio, 1.0 / advance, np.pi * _BINS / (32 * width))
    half = np.pi / travel
    smallest = test.around[0] * half
    if largest < 1.5 * smallest:
        return None
    cell = np.pi / (4 * largest)
    n_bins = 4 * int(np.ceil(width / cell) + 1)
    spectra = np.array([unit.spectrum(low, cell, n_bins) for unit in units])
    ratios: Array = 2 * np.pi * np.fft.rfftfreq(n_bins, cell).astype(np.float64)
    total = spectra.mean(axis=0)
    best = (0.0, 0, 0.0)  # power with harmonics, place, height
    for i, height in _standing_out(spectra, ratios, (smallest, largest), half, test):
        power = sum(total[np.abs(ratios - k * ratios[i]) < half].max(initial=0.0) for k in (1, 2, 3))
        best = (power, i, height) if power > 1.05 * best[0] else best
    if best[0] == 0:
        return None
    near = np.flatnonzero(np.abs(ratios - ratios[best[1]]) < half)
    top = int(near[total[near].argmax()])
    return float(ratios[top]), float(best[2] * total[top] / total[best[1]])


def _standing_out(
    spectra: Array, ratios: Array, ends: tuple[float, float], half: float, test: PeriodicTest
) -> Iterator[tuple[int, float]]:
    """Yield peaks that stand out in the mean and in every unit, highest first: place, height over the median around."""
    total, inside = spectra.mean(axis=0), (ratios > ends[0]) & (ratios < ends[1])
    places = np.flatnonzero(inside)
    for i in places[np.argsort(total[places])[::-1][:50]]:
        off = np.abs(ratios - ratios[i])
        around = inside & (off < max(ratios[i] / 3, test.around[1] * half)) & (off > test.around[0] * half)
        floor, middle = np.median(spectra[:, around], axis=1), np.median(total[around])
        in_every_unit = spectra[:, off < half].max(axis=1) > test.above_in_every_unit * floor
        if total[i] > test.above * middle and in_every_unit.all():
            yield int(i), float(total[i] / middle)


def _refined(units: Sequence[_Unit], ratio: float, test: PeriodicTest) -> float:
    """Return the ratio that explains most with its harmonics, or a whole number near it that nearly does."""

    def explained(r: float) -> float:
        return float(np.mean([unit.share([r, 2 * r, 3 * r]) for unit in units]))

    half = np.pi / max(unit.travel for unit in units)
    best = max((ratio + np.linspace(-1, 1, 21) * half).tolist(), key=explained)
    whole = float(round(best))
    is_whole = abs(best - whole) < half and explained(whole) > test.whole * explained(best)
    return whole if is_whole else float(f"{best:.4g}")
