r"""Worst-case H2 observers: filtering of a shaped disturbance, by one Riccati equation.

K is outside the loop of the uncertainty, so the worst case over the set is a disturbance spectrum, and the best K for a
given spectrum is a Kalman predictor, which corrects the state. The observer is designed for the average spectrum of the
set and certified on the set itself; where it guarantees less than no correction, nothing is corrected.

With ``d = C_d x_d + D_d nu``, ``x_d+ = A_d x_d + B_d nu`` the shaped input disturbance, and ``r``
the shaped disturbance of the state, the error is ``e = xi + r``, ``xi+ = A xi + B d - y^c``, ``y = C e + n``. The
correction has full authority over the state, so the optimum keeps the predicted error at zero:

    y^c = B C_d x_d^ + (C_r A_r - A C_r) x_r^ + (L_xi + C_r L_r) y,
    x_d^+ = A_d x_d^ + L_d y,    x_r^+ = A_r x_r^ + L_r y

with ``L`` the gain of the steady-state predictor of ``(xi, x_d, x_r)``. The order of K is that of the shaping filters
only.

The lower bound is in `members`, the disturbance in `disturbance`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core import StateSpace, block_diagonal, h2_norm
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import shaped_plant
from ..result import Injection, Status, Synthesis, enclosed
from ..riccati.h2 import predictor
from .certificate import certify_errors
from .disturbance import average_disturbance
from .members import lower_bound


def worst_case_h2(
    problem: ObserverProblem,
    *,
    max_order: int = 4,
    tolerance_db: float = 1.0,
) -> Synthesis:
    """Return an observer filter with a certified H2 norm for every member of the uncertain set.

    Parameters
    ----------
    problem : ObserverProblem
        Its correction enters at the state, whatever its `injection`.
    max_order : int
        Highest order of each shaping filter; the smallest within `tolerance_db` is taken.
    tolerance_db : float, dB
        Accuracy of the shaping filters. It costs optimality, never validity: the certificate uses the set itself.

    Returns
    -------
    Synthesis
        ``worst_case_h2`` with ``quadrature_error`` included, ``lower_bound`` for all observers of either injection, and
        their gap; ``h2_norm`` is the norm of the error under measurement noise alone (the nominal machine).

    Raises
    ------
    SynthesisError
        When the set is not well posed, the pair undetectable, a model unstable, or the design does not survive
        verification.

    Examples
    --------
    >>> from kros.core import StateSpace, gain
    >>> from kros.synthesis import ObserverProblem, worst_case_h2
    >>> lag, W_L, W_R = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01), gain([[0.1]], 0.01), gain([[1.0]], 0.01)
    >>> problem = ObserverProblem(lag, [[1.0]], W_L, W_R, [1.0], [1.0], [0.1])
    >>> observer = worst_case_h2(problem, max_order=1)
    >>> observer.lower_bound <= observer.worst_case_h2, observer.gap_percent < 5
    (True, True)
    """
    problem = replace(problem, injection=Injection.STATE)
    problem.require_sound()
    shaped = average_disturbance(problem, max_order, tolerance_db)
    controller = design(problem, *shaped)
    candidates = [certified(problem, K, "worst_case_h2") for K in (problem.nothing, controller)]
    best = min(candidates, key=lambda candidate: candidate.worst_case_h2 or 0.0)
    lower, gap, notes = enclosed(best.worst_case_h2 or 0.0, lower_bound(problem))
    note = "The spectral radius is that of the nominal loop and says nothing about robustness, worst_case_h2 does."
    return replace(best, lower_bound=lower, gap_percent=gap, notes=(note, *notes))


def certified(problem: ObserverProblem, controller: StateSpace, method: str) -> Synthesis:
    """Return a controller in physical units with its certificate; ``h2_norm`` is that of the noise alone."""
    loop, white = problem.error_system(controller), problem.nominal.n_inputs + problem.nominal.n_states
    value, error = certify_errors(problem, loop)
    return Synthesis(
        method=method,
        controller=controller,
        status=Status.CERTIFIED,
        injection=problem.injection,
        h2_norm=h2_norm(StateSpace(loop.A, loop.B[:, white:], loop.C, loop.D[:, white:], loop.dt)),
        worst_case_h2=value,
        quadrature_error=error,
        spectral_radius=loop.largest_pole(),
    )


def design(problem: ObserverProblem, d: StateSpace, r: StateSpace) -> StateSpace:
    """Return the filter that is H2-optimal for shaped disturbances of input and state, in physical units."""
    plant = shaped_plant(problem, d, r)
    A, B, _, _ = problem.scaled
    n, kd = len(A), d.n_states
    noises = plant.B1 @ plant.B1.T, plant.D21 @ plant.D21.T, plant.B1 @ plant.D21.T
    L, _ = predictor(plant.A, plant.C2, *noises, "Worst-case H2 synthesis")
    output = np.hstack([B @ d.C, r.C @ r.A - A @ r.C])
    return problem.to_physical(StateSpace(block_diagonal([d, r]).A, L[n:], output, L[:n] + r.C @ L[n + kd :], d.dt))
