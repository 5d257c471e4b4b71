"""The assumptions of H2 and H-infinity synthesis, each with its label and what to do when it fails.

The labels follow Zhou, Doyle and Glover, *Robust and Optimal Control*, section 14.5 (continuous time) and 21.7
(discrete time).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core import ITERATED, ROUNDING, TINY, AnyArray, DimensionError, SynthesisError
from ..core.linalg import balanced_size
from .generalized_plant import GeneralizedPlant

# Label and remedy of each assumption, on controls and on measurements.
REACHED = (
    ("A1a: (A, B2) stabilisable", "make the weights stable or let the control reach this mode"),
    ("A1b: (C2, A) detectable", "make the weights stable or measure this mode"),
)
REGULAR = (
    ("A2a: D12 of full column rank", "add a small correction penalty to z"),
    ("A2b: D21 of full row rank", "add measurement noise to w"),
)
NO_ZERO = (
    ("A3: no zero of (A, B2, C1, D12) on the stability boundary", "make the weights stable, or penalise more outputs"),
    ("A4: no zero of (A, B1, C2, D21) on the stability boundary", "make the weights stable, or add process noise"),
)
PROPER = "D11 = 0 in continuous time", "use a strictly proper weight"


def unreachable_modes(A: AnyArray, B: AnyArray, dt: float) -> list[complex]:
    """Return the eigenvalues on or beyond the stability boundary that B does not reach (Hautus test)."""
    if not A.size:
        return []
    size = balanced_size(A)  # and B is made as large as A, so that the test does not depend on units
    A, B = A * size / size[:, None], B / size[:, None]
    sizes = np.linalg.norm(B, axis=0)
    B = B / np.where(sizes > 0, sizes, 1.0) * max(float(np.linalg.norm(A, 2)), TINY)
    modes = np.linalg.eigvals(A)
    outside = modes[np.abs(modes) >= 1 - ROUNDING] if dt > 0 else modes[modes.real >= -ROUNDING * (1 + np.abs(modes))]
    unreached = []
    for mode in outside:
        s = np.linalg.svd(np.hstack([A - mode * np.eye(len(A)), B]), compute_uv=False)
        if s[-1] <= ITERATED * max(s[0], TINY):
            unreached.append(complex(mode))
    return unreached


def require(plant: Any, method: str, proper: bool = True) -> None:
    """Raise a `SynthesisError` that names every violated assumption, a `DimensionError` for what is no plant."""
    if not isinstance(plant, GeneralizedPlant):
        needed = "a GeneralizedPlant (A, B1, B2, C1, C2, D11, D12, D21, D22, dt)"
        raise DimensionError(f"{method} needs {needed}, found {type(plant).__name__}; build one first.")
    p, failed = plant, dict[tuple[str, str], str]()
    sides = p, p.dual
    for side, reached, regular in zip(sides, REACHED, REGULAR, strict=True):
        if modes := unreachable_modes(side.A, side.B2, p.dt):
            failed[reached] = f"mode {modes[0]:.6g}"
        D = side.D12
        if (rank := int(np.linalg.matrix_rank(D, rtol=ITERATED))) < D.shape[1]:
            failed[regular] = f"rank {rank} of {D.shape[1]}"
    if proper and p.dt == 0 and np.any(p.D11):
        failed[PROPER] = f"largest entry {np.abs(p.D11).max():.3g}"
    if not failed:
        zeros = zip(NO_ZERO, map(_boundary_zeros, sides), strict=True)
        failed = {label: f"zero {found[0]:.6g}" for label, found in zeros if found}
    if failed:
        texts = [f"{label} ({value}): {fix}" for (label, fix), value in failed.items()]
        raise SynthesisError(f"{method} needs a regular generalized plant; violated: {'; '.join(texts)}.")


def require_detectable(A: AnyArray, C: AnyArray, dt: float, method: str) -> None:
    """Raise a `SynthesisError` naming the first mode on or beyond the stability boundary that C does not see."""
    modes = unreachable_modes(A.T, C.T, dt)
    if modes:
        problem = f"mode {modes[0]:.6g} is on or outside the unit circle and invisible in y"
        raise SynthesisError(f"{method}: (A, C) is not detectable, {problem}; measure another state.")


def _boundary_zeros(p: GeneralizedPlant) -> list[complex]:
    """Zeros on the stability boundary: D12 of full column rank, eigenvalues of A - B2 D12^+ C1 that the rest sees."""
    solved = np.linalg.pinv(p.D12) @ p.C1
    modes = unreachable_modes((p.A - p.B2 @ solved).T, (p.C1 - p.D12 @ solved).T, p.dt)
    return [mode for mode in modes if (abs(mode) - 1 if p.dt > 0 else mode.real / (1 + abs(mode))) < ROUNDING]
