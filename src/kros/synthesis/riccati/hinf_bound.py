r"""The largest level that is proven to be out of reach of every controller.

    level --> pencils of both sides --> signals --------> energies (`hinf_dual`) --> bound --> next level
                      |                                                               ^
                      +--> eigenvalues near the boundary --> Parrott (`hinf_pointwise`)

The levels only say where to look. Errors of a level enter the bound squared, so that a few of them suffice.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..generalized_plant import GeneralizedPlant
from .hinf_coordinates import balancing, scaled, transformed
from .hinf_dual import Signals, coupled, evaluated
from .hinf_pencil import Side
from .hinf_pointwise import direct_bound, pointwise_bound, resonances

Array = npt.NDArray[Any]

_LEVELS = 8
_NEAR = 1e-2
_MARGIN = 1e-9  # constraints hold to rounding, not exactly
_GRID = 200


def proven_bound(plant: GeneralizedPlant, attained: float, tolerance: float) -> float:
    """Return a number that the H-infinity norm of no stable closed loop is below; tight for regular plants."""
    p = scaled(replace(plant, D22=np.zeros_like(plant.D22)))
    best = max(direct_bound(p), pointwise_bound(p, _grid(p)))
    n = len(p.A)
    frames = [(np.eye(n), np.eye(n)), *([] if (found := balancing(p)) is None else [found])] if n else []
    for T, back in frames:
        q, level = transformed(p, T, back), attained * (1 - tolerance / 2)
        for _ in range(_LEVELS):
            families, candidates, complete = _stationary(p, q, T, back, level)
            before = best
            best = max(best, pointwise_bound(p, candidates) if candidates.size else 0.0)
            best = max([best, *(coupled(a, b) for a in families[0] for b in families[1])])
            if best >= attained * (1 - tolerance / 2):
                return best * (1 - _MARGIN)
            if best <= before * (1 + 1e-9) and complete:
                break
            level = best if complete else float(np.sqrt(max(best, 1e-3 * attained) * attained))
            if level >= attained:
                break
    return best * (1 - _MARGIN)


def _stationary(
    p: GeneralizedPlant, q: GeneralizedPlant, T: Array, back: Array, level: float
) -> tuple[tuple[list[Signals], list[Signals]], Array, bool]:
    """Signals of both sides, computed in the coordinates of q and judged in those of p, and frequencies at which the level may be attained."""
    families: tuple[list[Signals], list[Signals]] = ([Signals.none(len(p.A))], [Signals.none(len(p.A))])
    values, complete = [np.zeros(0)], True
    for family, here, there, change in zip(families, Side.both(p), Side.both(q), (back, T.T), strict=True):
        basis = there.reachable()
        if not basis.shape[1]:
            continue
        eigenvalues, found = there.within(basis).signals(level)
        values.append(eigenvalues)
        judged = [evaluated(here, change @ basis @ V, M, G) for V, M, G in found]
        family += [signals for signals in judged if signals is not None]
        complete &= len(family) > 1
    return families, _candidates(np.concatenate(values), p.dt > 0), complete


def _candidates(values: Array, discrete: bool) -> Array:
    """Frequencies of eigenvalues near the boundary, and the points between them."""
    values = values[np.isfinite(values) & (values != 0)].astype(complex)
    s = np.log(values) if discrete else values
    near = s[(np.abs(s.real) <= _NEAR * np.abs(s)) & (s.imag >= 0)].imag
    if not near.size:
        return near
    points = np.unique(np.append(near, 0.0))
    return np.unique(np.concatenate([points, (points[1:] + points[:-1]) / 2, np.sqrt(points[1:] * points[:-1])]))


def _grid(p: GeneralizedPlant) -> Array:
    """Frequencies of a first look, rad/s or rad per sample."""
    discrete = p.dt > 0
    sizes = np.abs(np.linalg.eigvals(p.A)) if len(p.A) else np.ones(1)
    top = np.pi if discrete else 30 * max(float(sizes.max()), 1e-300)
    low = 1e-6 * top if discrete else max(float(sizes.min()), 1e-6 * top) / 30
    return np.unique(np.concatenate([[0.0], np.geomspace(low, top, _GRID), resonances(p.A, discrete)]))
