r"""The paper's mixed problem (37)-(39) for observers: matrix inequalities on its reduced, regularised plant.

In that problem ``T11`` does not depend on the uncertainty and ``T22`` not on K: its exact optimum is "no correction". What makes the published
gain useful is the common Lyapunov matrix, which adds the response to w2 to the cost. Hence nothing here is improved afterwards or searched over
scalings: that would only remove the correction.

But the scaling of channel 2 is not arbitrary either. The same set is written by ``(W_L, W_R)`` and by ``(W_L / c, c W_R)``, and with one Lyapunov
matrix for both channels an impulse of w1 must not leave more energy in z2 than gamma squared. The published problem has ``W_R = W_u = 1``, so
channel 2 is scaled until the impulse response from the inputs to z2, which K does not influence, has unit energy; where that is not enough, until
its gain is one at all frequencies.
"""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import product

import numpy as np

from ...core.errors import SynthesisError
from ...core.lti import StateSpace, gain
from ...core.norms import gramian, hinf_norm
from ..generalized_plant import GeneralizedPlant
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import mixed_plant
from ..result import Status, Synthesis
from ..worst_case.certificate import certify
from .candidates import by_inequalities
from .channels import Verified, require_reachable

# Least measurement noise in the inequalities, as a fraction of the measured channel's range, tenfold where the result is no
# better than nothing: they do not resolve an encoder's 1e-7. The certificate uses the true noise.
_NOISE_FLOOR = 1e-3
_NOTHING = 1e-3  # an observer this much worse than no correction may be owed to the reduction of the plant


def for_observer(problem: ObserverProblem, gamma: float, max_states: int, time_limit_s: float) -> Synthesis:
    """Solve the reduced observer problem on noise that the inequalities resolve; certify the filter on the set, in physical units."""
    problem.require_sound()
    start = time.perf_counter()
    end = start + time_limit_s
    nothing = gain(np.zeros(problem.error_plant().D22.T.shape), problem.nominal.dt)
    idle = certify(problem, nothing)[0]
    if idle == 0:
        return _without_correction(problem, nothing, start)
    best: Synthesis | None = None
    reasons: list[str] = []
    for floor, states in product((_NOISE_FLOOR, 10 * _NOISE_FLOOR), _around(max_states)):
        noisy = replace(problem, noise=np.maximum(problem.noise, floor * (np.abs(problem.C) @ problem.output_scale)))
        plant = mixed_plant(noisy, noise_floor=0.0)
        require_reachable(
            plant, gamma
        )  # K does not enter T22, so that this is all there is to say about the constraint
        for scaling in canonical_scalings(plant):
            failed: list[str] = []
            notes: list[str] = []
            found = by_inequalities(plant, gamma, (scaling,), states, end, failed, notes)
            if found:
                made = _certified(problem, noisy, min(found, key=lambda v: v.h2), notes, start)
                best = made if best is None or _worst(made) < _worst(best) else best
                break
            reasons.append(
                f"with measurement noise of {floor:g} of the range and {states} states: {'; '.join(dict.fromkeys(failed))}"
            )
        if best is not None and (_worst(best) <= idle * (1 + _NOTHING) or floor > _NOISE_FLOOR):
            return best
    if best is not None:
        return best
    raise SynthesisError(
        f"Mixed synthesis of an observer: no controller survived; {'. '.join(dict.fromkeys(reasons))}. Raise the noise, gamma or the time limit."
    )


def _around(max_states: int) -> list[int]:
    """Sizes of the reduced plant: as asked, larger where the reduction costs too much, smaller where nothing is found."""
    return list(dict.fromkeys((max_states, max_states + 2, max(max_states - 2, 1))))


def _worst(found: Synthesis) -> float:
    return np.inf if found.worst_case_h2 is None else found.worst_case_h2


def canonical_scalings(plant: GeneralizedPlant) -> list[float]:
    """Scalings of channel 2 in which the disturbances w1 reach z2 with unit energy, or with unit gain."""
    rows, columns = plant.rows(2), plant.columns(1)
    B, C, D = plant.B1[:, columns], plant.C1[rows], plant.D11[rows][:, columns]
    energy = B.T @ gramian(plant.A.T, C.T, plant.dt) @ B + D.T @ D
    size = float(np.sqrt(np.linalg.norm(energy, 2))) if energy.size else 0.0
    peak = hinf_norm(StateSpace(plant.A, B, C, D, plant.dt))
    return [size, peak] if size > 0 else [1.0]


def _without_correction(problem: ObserverProblem, nothing: StateSpace, start: float) -> Synthesis:
    """Answer for a set that holds the nominal model alone."""
    return Synthesis(
        method="mixed",
        controller=nothing,
        status=Status.OPTIMAL,
        injection=problem.injection,
        h2_norm=0.0,
        worst_case_h2=0.0,
        quadrature_error=0.0,
        lower_bound=0.0,
        spectral_radius=float(problem.error_system(nothing).spectral_radius()),
        solve_s=time.perf_counter() - start,
        notes=("No model of the set differs from the nominal one: without correction there is no error.",),
    )


def _certified(
    problem: ObserverProblem, noisy: ObserverProblem, best: Verified, notes: list[str], start: float
) -> Synthesis:
    """Certify what was found on the noisy problem for the true one."""
    controller = noisy.to_physical(best.controller)
    elapsed = time.perf_counter() - start
    value, error = certify(problem, controller)
    return Synthesis(
        method="mixed",
        controller=controller,
        status=Status.CERTIFIED if best.optimal else Status.INACCURATE,
        injection=problem.injection,
        h2_norm=best.h2,
        hinf_norm=best.hinf,
        worst_case_h2=value,
        quadrature_error=error,
        spectral_radius=float(problem.error_system(controller).spectral_radius()),
        solve_s=elapsed,
        solver="barrier",
        notes=(
            *notes,
            f"Found by: {best.origin}.",
            "T11 contains the measurement noise only and T22 does not depend on K; worst_case_h2 is the meaningful number. "
            "The spectral radius is that of the nominal loop and says nothing about robustness.",
        ),
    )
