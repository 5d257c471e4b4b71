"""Candidates of mixed synthesis: controllers from matrix inequalities and from H-infinity synthesis, each verified on the full plant."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.linalg import LinAlgError

from ...core.errors import KrosError, SynthesisError
from ..generalized_plant import GeneralizedPlant
from ..reduction.truncation import truncate
from ..riccati.h2_optimal import absorb_feedthrough
from ..riccati.hinf_optimal import hinf
from .balance import balance
from .channels import Verified, scaled, verify
from .inequalities import MixedInequalities
from .solvers import Answer, Program, solve_with_fallback


def by_inequalities(
    plant: GeneralizedPlant,
    gamma: float,
    scalings: Sequence[float],
    max_states: int,
    end: float,
    reasons: list[str],
    notes: list[str],
    solvers: Sequence[str] | None = None,
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
        try:
            balanced = balance(scaled(small, a))
            inequalities = MixedInequalities(balanced, gamma)
            program = Program(inequalities.objective(), inequalities.blocks(), inequalities.start())
        except (SynthesisError, LinAlgError, ValueError) as error:
            reasons.append(f"scaling {a:g}: {error}")
            continue
        label = f"inequalities, scaling {a:g}"

        def check(answer: Answer, inequalities: MixedInequalities = inequalities, label: str = label) -> Verified | str:
            assert answer.x is not None
            try:
                K = absorb_feedthrough(inequalities.controller(answer.x), plant.D22)
            except (LinAlgError, KrosError) as error:
                return f"{answer.solver}: the controller cannot be recovered ({error})"
            value = inequalities.balanced.size * np.sqrt(max(answer.value, 0.0))
            return verify(
                plant, K, gamma, f"{answer.solver} ({answer.word}), {label}, their value {value:.6g}", answer.solver.lower(), answer.optimal
            )

        result = solve_with_fallback(program, check, time_limit_s=left, solvers=solvers)
        reasons += [f"{label}, {note}" for note in result.notes]
        if result.accepted is not None:
            found.append(result.accepted)
    return found


def by_hinf(plant: GeneralizedPlant, gamma: float, end: float, reasons: list[str]) -> list[Verified]:
    """Candidates from H-infinity synthesis of both channels together, channel 1 with less and less weight."""
    found: list[Verified] = []
    one_z, one_w = plant.rows(1), plant.columns(1)
    for share in (0.3, 0.1, 0.03, 0.01, 1e-3):
        if time.perf_counter() > end:
            break
        left, right = np.ones(plant.sizes[3]), np.ones(plant.sizes[1])
        left[one_z], right[one_w] = share, share
        weighted = replace(
            plant,
            B1=plant.B1 * right,
            D21=plant.D21 * right,
            C1=plant.C1 * left[:, None],
            D12=plant.D12 * left[:, None],
            D11=plant.D11 * left[:, None] * right,
        )
        try:
            K = hinf(weighted, gamma=gamma * (1 - 1e-3)).controller
        except KrosError as error:
            reasons.append(f"H-infinity synthesis, channel 1 times {share:g}: {error}")
            continue
        verdict = verify(plant, K, gamma, f"H-infinity synthesis, channel 1 times {share:g}", "riccati")
        if isinstance(verdict, Verified):
            found.append(verdict)
            if len(found) == 2:
                break
    return found


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
