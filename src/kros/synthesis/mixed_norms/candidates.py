"""Controllers of mixed problems from matrix inequalities, each verified on the full plant."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.linalg import LinAlgError

from ...core.errors import KrosError, SynthesisError
from ...core.lti import StateSpace
from ...core.norms import h2_norm, hinf_norm
from ..generalized_plant import GeneralizedPlant
from ..reduction import truncate
from ..result import Status, Synthesis
from .barrier import Ending, minimise
from .inequalities import MixedInequalities, balance

_ACCURACY = 1e-4  # of the inequalities' optimum, relative


def infeasible(gamma: float, least: float) -> SynthesisError:
    """Return the error for a level that no controller attains."""
    return SynthesisError(
        f"Mixed synthesis: gamma = {gamma:g} is infeasible, no controller has ||T22|| below {least:.6g}; raise "
        "gamma, or make the weights of "
        "channel 2 smaller."
    )


def verify(plant: GeneralizedPlant, controller: StateSpace, gamma: float, note: str) -> Synthesis:
    """Recompute everything on the plant; a `SynthesisError` says why the controller is rejected."""
    if not all(np.isfinite(getattr(controller, name)).all() for name in "ABCD"):
        raise SynthesisError(f"{note}: the controller is not finite")
    radius = plant.close(controller).largest_pole()
    if radius >= 1:
        raise SynthesisError(f"{note}: closed loop unstable, spectral radius {radius:.6g}")
    norm, peak = h2_norm(plant.performance.close(controller)), hinf_norm(plant.uncertainty.close(controller))
    if peak >= gamma or not np.isfinite(norm):
        raise SynthesisError(
            f"{note}: ||T22|| = {peak:.6g} should be below {gamma:g}, and ||T11||_2 = {norm:.6g} finite"
        )
    return Synthesis(
        method="mixed",
        controller=controller,
        status=Status.CERTIFIED,
        h2_norm=norm,
        hinf_norm=peak,
        spectral_radius=radius,
        solver="barrier",
        notes=(f"{note}.",),
    )


def by_inequalities(
    plant: GeneralizedPlant, gamma: float, scalings: Sequence[float], max_states: int, end: float
) -> list[Synthesis]:
    """Controllers of a plant (D22 = 0) from the matrix inequalities, one for each scaling that works.

    A `SynthesisError` where none does.
    """
    small, note = _reduced(plant, max_states)
    results, reasons = [], []
    for a in scalings:
        left = end - time.perf_counter()
        try:
            if left <= 0:
                raise SynthesisError("the time limit was reached")
            candidate = _candidate(plant, scaled(small, a), gamma, f"Found by inequalities with scaling {a:g}", left)
            results.append(replace(candidate, notes=(*note, *candidate.notes)))
        except (KrosError, LinAlgError, ValueError) as error:
            reasons.append(str(error))
    if not results:
        raise SynthesisError(
            f"Mixed synthesis: no controller survived; {'; '.join(dict.fromkeys(reasons))}. Raise gamma = {gamma:g}, "
            "max_states, noise or the "
            "time limit."
        )
    return results


def _candidate(
    plant: GeneralizedPlant, small: GeneralizedPlant, gamma: float, note: str, time_limit_s: float
) -> Synthesis:
    """Solve the inequalities of the small plant and verify the controller on the whole one."""
    inequalities = MixedInequalities(balance(small), gamma)
    solved = minimise(
        inequalities.objective(), inequalities.blocks(), inequalities.start(), rtol=_ACCURACY, time_limit_s=time_limit_s
    )
    if solved.x is None or not np.isfinite(solved.value):
        raise SynthesisError(f"{note}: {solved.ending.value}")
    value = inequalities.balanced.size * np.sqrt(max(solved.value, 0.0))
    note = f"{note} ({solved.ending.value}), their value {value:.6g}"
    status = Status.CERTIFIED if solved.ending is Ending.SOLVED else Status.INACCURATE
    return replace(verify(plant, inequalities.controller(solved.x), gamma, note), status=status)


def scaled(plant: GeneralizedPlant, a: float) -> GeneralizedPlant:
    """Scale channel 2: ``w2 -> a w2``, ``z2 -> z2 / a``."""
    left, right = np.ones(plant.sizes[3]), np.ones(plant.sizes[1])
    left[plant.rows(2)], right[plant.columns(2)] = 1 / a, a
    return plant.transformed(z=np.diag(left), w=np.diag(right))


def _reduced(plant: GeneralizedPlant, max_states: int) -> tuple[GeneralizedPlant, tuple[str, ...]]:
    """Plant for the inequalities, and what was done to it; measurements count in units of their noise."""
    noise = np.linalg.norm(plant.D21[:, plant.columns(1)], axis=1)
    if plant.open_loop().largest_pole() >= 1:
        return plant, ()
    small, tail = truncate(plant.transformed(y=np.diag(1 / noise)), max_states)
    if small.sizes[0] == plant.sizes[0]:
        return plant, ()
    note = (
        f"Inequalities on {small.sizes[0]} of {plant.sizes[0]} states (discarded Hankel singular values sum to "
        f"{tail:.2g} of the largest); "
        "verified on all."
    )
    return small.transformed(y=np.diag(noise)), (note,)
