"""A ratio of gears, or gravity, seen in recordings: what a linear model of one step leaves, against an angle.

Symbols
-------
e_k   : residual of ``x_{k+1}`` regressed on the states and inputs of the last steps, each unit by itself
q_k   : angle, rad
P(r)  : ``2 |sum_k e_k exp(-i r q_k)|^2 / (N sum_k e_k^2)``, about the share of the residual that ``sin(r q)`` and ``cos(r q)`` explain. All r at once
        by a histogram of the residual over the angle and one FFT.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..data.population import EpisodeKey, Population

Array = npt.NDArray[np.float64]
LARGEST_RATIO = 500.0
_LAGS, _UNITS, _EPISODES, _SAMPLES = 3, 6, 3, 40_000
_ABOVE = 15.0  # of a peak over the median around it; the largest of some thousand values of noise alone is about 8 times their median
_EVERY_UNIT = 3.0  # of each unit's own peak over its own surroundings
_SHARE = 0.002  # of the residual that a term has to explain
_GRAVITY, _LEAST_TRAVEL = (
    0.01,
    0.5,
)  # the same for sin(angle), which other smooth terms resemble, and the travel that it needs, rad
_ODD = 0.9  # of what sine and cosine explain
_WHOLE = 0.8  # of what the best ratio explains, that a whole number near it has to explain to be taken
_BINS = 1 << 21


@dataclass(frozen=True)
class PeriodicTerm:
    """A term of an angle that a linear model lacks."""

    angle: str
    ratio: float
    share: float
    above: float
    odd: bool = False


def periodic_term(
    population: Population, angles: Sequence[str], keys: Sequence[EpisodeKey] | None = None
) -> PeriodicTerm | None:
    """Return the periodic term that shows most, or None where none does."""
    keys = _some_keys(population) if keys is None else keys
    units = [[population.read(k) for k in keys if k.unit == unit] for unit in dict.fromkeys(k.unit for k in keys)]
    names = population.states + population.inputs
    found = [_of_angle(units, names.index(a), len(population.states), a) for a in angles]
    return max((f for f in found if f is not None), key=lambda f: f.share, default=None)


def _some_keys(population: Population) -> list[EpisodeKey]:
    condition = "noload" if "noload" in population.conditions else population.conditions[0]
    return [k for u in population.unit_ids[:_UNITS] for k in population.keys(u, condition)[:_EPISODES]]


def _of_angle(units: Sequence[Sequence[Array]], column: int, n_states: int, name: str) -> PeriodicTerm | None:
    parts = [_residuals(episodes, column, n_states) for episodes in units]
    parts = [p for p in parts if len(p[1]) > 20 * _LAGS * parts[0][2].shape[1]]
    if not parts:
        return None
    low, high = min(q.min() for _, q, _ in parts), max(q.max() for _, q, _ in parts)
    travel = max(float(np.ptp(q)) for _, q, _ in parts)
    peak = _peak(parts, low, high - low, travel)
    if peak is not None and (share := max(_share(p, [peak[0]]) for p in parts)) > _SHARE:
        return PeriodicTerm(name, _refined(parts, peak[0], travel), share, peak[1])
    shares = [_share(p, [1.0]) for p in parts]
    if min(shares) < _GRAVITY or travel < _LEAST_TRAVEL:
        return None
    odd = np.mean([_share(p, [1.0], (np.sin,)) for p in parts]) > _ODD * np.mean(shares)
    return PeriodicTerm(name, 1.0, float(np.mean(shares)), np.inf, bool(odd))


def _residuals(episodes: Sequence[Array], column: int, n_states: int) -> tuple[Array, Array, Array]:
    """Return residuals of one step (n, n_states), the angle before it (n,) and an orthonormal basis of the regressors (n, p), of one unit."""
    scale = np.maximum(np.max([np.abs(v).max(axis=0) for v in episodes], axis=0), 1e-300)
    rows, targets, angles, left = [], [], [], _SAMPLES
    for values in episodes:
        x = values[:left] / scale
        n = len(x) - _LAGS
        if n < 1:
            continue
        rows.append(
            np.hstack(
                [
                    *(x[_LAGS - 1 - lag : _LAGS - 1 - lag + n] for lag in range(_LAGS)),
                    x[_LAGS:, n_states:],
                    np.ones((n, 1)),
                ]
            )
        )
        targets.append(x[_LAGS:, :n_states])
        angles.append(values[_LAGS - 1 : _LAGS - 1 + n, column])
        left = max(left - len(x), 0)
    u, s, _ = np.linalg.svd(np.vstack(rows), full_matrices=False)
    basis, y = u[:, s > 1e-10 * s[0]], np.vstack(targets)
    return y - basis @ (basis.T @ y), np.concatenate(angles), basis


def _peak(
    parts: Sequence[tuple[Array, Array, Array]], low: float, width: float, travel: float
) -> tuple[float, float] | None:
    """Return the ratio of the fundamental, and how far its peak stands out."""
    advance = max(float(np.quantile(np.abs(np.diff(q)), 0.9)) for _, q, _ in parts)
    largest = (
        min(LARGEST_RATIO, 1.0 / advance if advance > 0 else np.inf, np.pi * _BINS / (32 * width)) if width > 0 else 0.0
    )
    smallest = 6 * np.pi / travel if travel > 0 else np.inf
    if largest < 1.5 * smallest:
        return None
    cell = np.pi / (4 * largest)
    n_bins = 4 * int(np.ceil(width / cell) + 1)
    spectra = np.array([_spectrum(e, q - low, cell, n_bins) for e, q, _ in parts])
    ratios: Array = 2 * np.pi * np.fft.rfftfreq(n_bins, cell).astype(np.float64)
    total = spectra.mean(axis=0)
    inside = np.flatnonzero((ratios > smallest) & (ratios < largest))
    best: tuple[float, int] | None = None
    floors: dict[int, npt.NDArray[np.bool_]] = {}
    for i in inside[np.argsort(total[inside])[::-1][:50]]:
        around = _around(ratios, float(ratios[i]), 2 * np.pi / travel, smallest, largest)
        floor = np.median(spectra[:, around], axis=1)
        near = np.abs(ratios - ratios[i]) < np.pi / travel
        if total[i] > _ABOVE * np.median(total[around]) and (spectra[:, near].max(axis=1) > _EVERY_UNIT * floor).all():
            floors[int(i)] = around
            harmonics = sum((_at(total, ratios, k * float(ratios[i]), np.pi / travel) for k in (1, 2, 3)), 0.0)
            if best is None or harmonics > 1.05 * best[0]:
                best = harmonics, int(i)
    if best is None:
        return None
    near = np.flatnonzero(np.abs(ratios - ratios[best[1]]) < np.pi / travel)
    top = int(near[total[near].argmax()])
    return float(ratios[top]), float(total[top] / np.median(total[floors[best[1]]]))


def _refined(parts: Sequence[tuple[Array, Array, Array]], ratio: float, travel: float) -> float:
    """Return the ratio that explains most with its harmonics, or the whole number near it that explains nearly as much."""

    def explained(r: float) -> float:
        return float(np.mean([_share(p, [r, 2 * r, 3 * r]) for p in parts]))

    near = ratio + np.linspace(-1, 1, 21) * np.pi / travel
    best = max(near.tolist(), key=explained)
    whole = float(round(best))
    is_whole = abs(best - whole) < np.pi / travel and explained(whole) > _WHOLE * explained(best)
    return whole if is_whole else float(f"{best:.4g}")


def _spectrum(residuals: Array, angle: Array, cell: float, n_bins: int) -> Array:
    """Return P(r), the largest over the states, shape (n_bins // 2 + 1,)."""
    place = (angle / cell).astype(np.int64)
    power = np.zeros(n_bins // 2 + 1)
    for e in residuals.T:
        energy = float(e @ e)
        if energy > 0:
            own = np.abs(np.fft.rfft(np.bincount(place, weights=e, minlength=n_bins))) ** 2
            power = np.maximum(power, 2 * own / (len(e) * energy))
    return power


def _around(ratios: Array, ratio: float, resolution: float, smallest: float, largest: float) -> npt.NDArray[np.bool_]:
    """Ratios near one, without its own peak."""
    reach = max(ratio / 3, 20 * resolution)
    return np.asarray(
        (np.abs(ratios - ratio) < reach)
        & (np.abs(ratios - ratio) > 3 * resolution)
        & (ratios > smallest)
        & (ratios < largest)
    )


def _at(power: Array, ratios: Array, ratio: float, half: float) -> float:
    near = power[np.abs(ratios - ratio) < half]
    return float(near.max()) if near.size else 0.0


def _share(
    part: tuple[Array, Array, Array], ratios: Sequence[float], functions: Sequence[np.ufunc] = (np.sin, np.cos)
) -> float:
    """Return the share of the residual of one unit that sines and cosines explain beside the regressors, the largest over the states."""
    residuals, angle, basis = part
    pair = np.stack([f(r * angle) for r in ratios for f in functions], axis=1)
    pair -= basis @ (basis.T @ pair)
    u, s, _ = np.linalg.svd(pair, full_matrices=False)
    u = u[:, s > 1e-8 * np.sqrt(len(angle))]
    energy = np.sum(residuals**2, axis=0)
    return float(np.max(np.sum((u.T @ residuals) ** 2, axis=0) / np.maximum(energy, 1e-300), initial=0.0))
