"""Candidates of mixed synthesis: controllers from matrix inequalities, each verified on the full plant."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.linalg import LinAlgError

from ...core.errors import KrosError, SynthesisError
from ...core.lti import StateSpace
from ..generalized_plant import GeneralizedPlant
from ..reduction.truncation import truncate
from ..riccati.equations import absorb_feedthrough
from .balance import balance, reached
from .barrier import Ending, minimise
from .channels import Verified, scaled, verify
from .inequalities import MixedInequalities

_ACCURACY = 1e-4


def by_inequalities(
    plant: GeneralizedPlant,
    gamma: float,
    scalings: Sequence[float],
    max_states: int,
    end: float,
    reasons: list[str],
    notes: list[str],
) -> list[Verified]:
    """Candidates from the matrix inequalities, one for each scaling that works."""
    small, done = reduced(plant, max_states)
    notes += done
    found: list[Verified] = []
    for a in scalings:
        left = end - time.perf_counter()
        if left <= 0:
            reasons.append("the time limit was reached")
            break
        verdict = _candidate(plant, scaled(small, a), gamma, f"inequalities, scaling {a:g}", left)
        if isinstance(verdict, Verified):
            found.append(verdict)
        else:
            reasons.append(verdict)
    return found


def _candidate(
    plant: GeneralizedPlant, small: GeneralizedPlant, gamma: float, label: str, time_limit_s: float
) -> Verified | str:
    """Solve the inequalities of the small plant and verify the controller on the whole one; a text says why there is none."""
    try:
        inequalities = MixedInequalities(balance(reached(small)), gamma)
        blocks, start = inequalities.blocks(), inequalities.start()
    except (SynthesisError, LinAlgError, ValueError) as error:
        return f"{label}: {error}"
    solved = minimise(inequalities.objective(), blocks, start, rtol=_ACCURACY, time_limit_s=time_limit_s)
    if solved.x is None or not np.isfinite(solved.value):
        return f"{label}: {solved.ending.value}"
    try:
        K: StateSpace = absorb_feedthrough(inequalities.controller(solved.x), plant.D22)
    except (LinAlgError, KrosError) as error:
        return f"{label}: the controller cannot be recovered ({error})"
    value = inequalities.balanced.size * np.sqrt(max(solved.value, 0.0))
    origin = f"{label} ({solved.ending.value}), their value {value:.6g}"
    return verify(plant, K, gamma, origin, solved.ending is Ending.SOLVED)


def reduced(plant: GeneralizedPlant, max_states: int) -> tuple[GeneralizedPlant, list[str]]:
    """Plant for the inequalities, and what was done to it."""
    n = plant.sizes[0]
    radius = float(plant.open_loop().spectral_radius())
    if radius >= 1:
        # What can be reached and seen does not depend on the size of A.
        shrunk, _ = truncate(replace(plant, A=plant.A / (1.1 * radius)), n)
        small = replace(shrunk, A=shrunk.A * (1.1 * radius)) if shrunk.sizes[0] < n else plant
        kept = small.sizes[0]
        return small, [
            f"The plant is unstable and was made minimal only: {kept} of {n} states in the inequalities."
        ] if n > max_states else []
    # Truncation counts all signals alike, so measurements are taken in units of their noise.
    noise = np.linalg.norm(plant.D21[:, plant.columns(1)], axis=1)
    unit = np.where(noise > 0, noise, 1.0)[:, None]
    small, tail = truncate(replace(plant, C2=plant.C2 / unit, D21=plant.D21 / unit, D22=plant.D22 / unit), max_states)
    kept = small.sizes[0]
    if kept == n:
        return plant, []
    small = replace(small, C2=small.C2 * unit, D21=plant.D21, D22=plant.D22)
    return small, [
        f"Inequalities on {kept} of {n} states (discarded Hankel singular values sum to {tail:.2g} of the largest); verified on all."
    ]
