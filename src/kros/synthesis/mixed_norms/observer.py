r"""The paper's mixed problem (37)-(39) for observers: matrix inequalities on its reduced, regularised plant.

In that problem ``T11`` does not depend on the uncertainty and ``T22`` not on K: its exact optimum is "no correction".
What makes the published gain useful is the common Lyapunov matrix, which adds the response to w2 to the cost. Hence
nothing here is improved afterwards or searched over scalings: that would only remove the correction.

But the scaling of channel 2 is not arbitrary either. The same set is written by ``(W_L, W_R)`` and by ``(W_L / c, c
W_R)``, and with one Lyapunov matrix for both channels an impulse of w1 must not leave more energy in z2 than gamma
squared. The published problem has ``W_R = W_u = 1``, so channel 2 is scaled until the response from the inputs to z2,
which K does not influence, has a gain of one.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from ...core.lti import gain
from ...core.norms import hinf_norm
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import mixed_plant
from ..result import Status, Synthesis
from ..worst_case.certificate import certified
from .candidates import by_inequalities, infeasible


def for_observer(problem: ObserverProblem, gamma: float, max_states: int, time_limit_s: float) -> Synthesis:
    """Solve the reduced observer problem on noise that the inequalities resolve.

    Certify the filter on the set, in physical units.
    """
    size = problem.require_sound()
    start = time.perf_counter()
    nothing = gain(np.zeros((problem.correction_size, len(problem.C))), problem.nominal.dt)
    idle = certified(problem, nothing, "mixed")
    if idle.worst_case_h2 == 0:
        note = "No model of the set differs from the nominal one: without correction there is no error."
        return replace(idle, status=Status.OPTIMAL, lower_bound=0.0, notes=(note,))
    if size >= gamma:  # K does not enter T22 = N
        raise infeasible(gamma, size)
    plant = mixed_plant(problem)
    peak = hinf_norm(plant.channel(plant.rows(2), plant.columns(1)).close(nothing))
    best = by_inequalities(plant, gamma, (peak or 1.0,), max_states, start + time_limit_s)[0]
    elapsed = time.perf_counter() - start
    result = certified(problem, problem.to_physical(best.controller), "mixed")
    notes = [
        "T11 contains the measurement noise only and T22 does not depend on K; worst_case_h2 is the meaningful number. "
        "The spectral radius is that of the nominal loop and says nothing about robustness."
    ]
    if (result.worst_case_h2 or 0.0) >= (idle.worst_case_h2 or 0.0):
        notes.append(f"No better than no correction, whose certified worst case is {idle.worst_case_h2:.6g}.")
    return replace(
        result,
        status=best.status,
        h2_norm=best.h2_norm,
        hinf_norm=best.hinf_norm,
        solve_s=elapsed,
        solver="barrier",
        notes=(*best.notes, *notes),
    )
