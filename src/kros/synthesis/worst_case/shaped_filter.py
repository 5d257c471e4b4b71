r"""Filters for a shaped disturbance, and what no filter does better.

*State injection.* With ``d = C_d x_d + D_d nu``, ``x_d+ = A_d x_d + B_d nu`` the shaped input disturbance, and ``r`` the shaped remainder,
the error is ``e = xi + r``, ``xi+ = A xi + B d - y^c``, ``y = C e + n``. The correction has full authority over the state, so the optimum keeps
the predicted error at zero:

    y^c = B C_d x_d^ + (C_r A_r - A C_r) x_r^ + (L_xi + C_r L_r) y,        x_d^+ = A_d x_d^ + L_d y,    x_r^+ = A_r x_r^ + L_r y

with ``L`` the gain of the steady-state predictor of ``(xi, x_d, x_r)``. The order of K is that of the shaping filters only. A performance
weight with states of its own makes past errors matter, which a predictor cannot mend: then, as for input injection, the H2 controller of the
whole plant is taken.

*Lower bound.* The same model, driven by filters that lie below the set's spectrum, gives an error that no observer beats: state injection contains
input injection (``K_state = B K_input``), and an observer's ``W_p x_hat`` is one of the causal estimates of ``W_p x`` over which a predictor is the
best. It is proven by `riccati.filter_bound`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import shaped_plant
from ..result import Injection
from ..riccati.constant_gain import predictor
from ..riccati.filter_bound import predictor_bound
from ..riccati.h2 import h2
from .disturbance import Shaping

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class _Model:
    """``s+ = A s + B w``, ``y = C s + D w``, ``W_p e = Z s + Z_w w`` for white w = (nu_d, nu_r, v, n); the first states are those of xi, d and r."""

    A: Array
    B: Array
    C: Array
    D: Array
    Z: Array
    Z_w: Array

    @classmethod
    def of(cls, problem: ObserverProblem, d: StateSpace, r: StateSpace) -> _Model:
        """Join the nominal error dynamics, the shaping filters at the input and at the state, and the performance weight."""
        A, B, C, D_p = problem.scaled
        n, q, p = A.shape[0], C.shape[0], problem.performance
        kd, kr, kp = d.n_states, r.n_states, p.n_states
        to_error = np.hstack([np.eye(n), np.zeros((n, kd)), r.C, np.zeros((n, kp))])
        feed = np.hstack([np.zeros((n, d.n_inputs)), r.D, np.zeros((n, n + q))])  # white part of e
        A_s = np.block(
            [
                [A, B @ d.C, np.zeros((n, kr + kp))],
                [np.zeros((kd, n)), d.A, np.zeros((kd, kr + kp))],
                [np.zeros((kr, n + kd)), r.A, np.zeros((kr, kp))],
                [p.B @ to_error[:, : n + kd + kr], p.A],
            ]
        )
        noise = np.hstack([np.diag(problem.scaled_process_noise), np.zeros((n, q))])
        B_s = np.block(
            [
                [B @ d.D, np.zeros((n, r.n_inputs)), noise],
                [d.B, np.zeros((kd, r.n_inputs + n + q))],
                [np.zeros((kr, d.n_inputs)), r.B, np.zeros((kr, n + q))],
                [p.B @ feed],
            ]
        )
        D_s = C @ feed
        D_s[:, D_s.shape[1] - q :] += np.eye(q)
        Z = D_p @ to_error
        Z[:, n + kd + kr :] = p.C
        return cls(A_s, B_s, C @ to_error, D_s, Z, D_p @ feed)


def design(problem: ObserverProblem, shaping: Shaping) -> StateSpace:
    """Return the filter that is H2-optimal for the shaped disturbances, in physical units."""
    d, r = shaping.at_input_and_state(problem)
    if problem.injection is Injection.INPUT or problem.performance.n_states:
        return problem.to_physical(h2(shaped_plant(problem, d, r)).controller)
    return problem.to_physical(_kalman(problem, d, r))


def lower_bound(problem: ObserverProblem, shaping: Shaping) -> float | None:
    """Return a worst-case H2 norm that no observer of either injection beats, for filters that lie below the spectrum; None where none is proven."""
    model = _Model.of(problem, *shaping.at_input_and_state(problem))
    squared = predictor_bound(model.A, model.B, model.C, model.D, model.Z)
    white = float(np.sum(model.Z_w**2)) * (1 - 1e-12)
    return float(np.sqrt((squared or 0.0) + white)) if squared or white else None


def _kalman(problem: ObserverProblem, d: StateSpace, r: StateSpace) -> StateSpace:
    """Best predictor for shaped disturbances: its filter for state injection, scaled."""
    model = _Model.of(problem, d, r)
    A, B, _, _ = problem.scaled
    n, kd, kr = len(A), d.n_states, r.n_states
    L, _ = predictor(
        model.A, model.C, model.B @ model.B.T, model.D @ model.D.T, model.B @ model.D.T, "Worst-case H2 synthesis"
    )
    L_xi, L_d, L_r = L[:n], L[n : n + kd], L[n + kd : n + kd + kr]
    return StateSpace(
        np.block([[d.A, np.zeros((kd, kr))], [np.zeros((kr, kd)), r.A]]),
        np.vstack([L_d, L_r]),
        np.hstack([B @ d.C, r.C @ r.A - A @ r.C]),
        L_xi + r.C @ L_r,
        d.dt,
    )
