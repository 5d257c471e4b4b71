r"""Lower bound of the worst case over the set: no observer does better on members of the set that are systems.

A constant contraction :math:`\Delta_i` gives a member of the set. On it the error is driven by the system ``D_i = W_L
Delta_i (I - N Delta_i)^-1 M``, and the least error of any observer is the optimum of a Riccati equation. The worst case
over the set is at least that, and at least the mean over some members: as the same observer meets all of them, the mean
is the optimum for ``[D_1 ... D_k] / sqrt(k)``, driven by independent white noises. Nothing depends on a grid. State
injection contains input injection (``K_state = B K_input``), and an observer's ``W_p x_hat`` is one of the causal
estimates of ``W_p x`` over which a predictor is the best.

The additive remainder has members of its own. Their mean is taken over both signs, so that the powers of remainder and
perturbation add.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...core import ROUNDING, AnyArray, StateSpace, block_diagonal, gain
from ..generalized_plant import interconnect
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import disturbed, shaped_plant
from ..riccati.h2 import predictor_bound


def lower_bound(problem: ObserverProblem) -> float | None:
    """Return the largest norm that members, one by one and all together, prove; None where they prove nothing."""
    W_L, W_R, dt = problem.W_L, problem.W_R, problem.nominal.dt
    members = [member(problem, sign * P) for P in shifts(W_L.n_inputs, W_R.n_outputs) for sign in (1.0, -1.0)]
    remainder = None
    if problem.remainder is not None:
        left, right = problem.remainder
        remainder = mean([left @ gain(P, dt) @ right for P in shifts(left.n_inputs, right.n_outputs)])
    bounds = [least_error(problem, one, remainder) for one in (*members, mean(members))]
    return max((bound for bound in bounds if bound > 0), default=None)


def shifts(rows: int, columns: int) -> list[AnyArray]:
    """Return the cyclic shifts of the identity that have this shape or are cut to it: contractions."""
    size = max(rows, columns)
    return [np.roll(np.eye(size), k, axis=0)[:rows, :columns] for k in range(size)]


def member(problem: ObserverProblem, delta: AnyArray) -> StateSpace:
    """Return ``W_L Delta (I - N Delta)^-1 M`` for a constant contraction."""
    blocks = {"M": problem.M, "N": problem.N, "Delta": gain(delta, problem.nominal.dt), "W_L": problem.W_L}
    wires = {"M": {"w1": 1.0}, "N": {"Delta": 1.0}, "Delta": {"M": 1.0, "N": 1.0}, "W_L": {"Delta": 1.0}}
    return interconnect(blocks, wires, {"w1": problem.M.n_inputs}, {"d": {"W_L": 1.0}})


def mean(systems: Sequence[StateSpace]) -> StateSpace:
    """Return ``[D_1 ... D_k] / sqrt(k)``, whose power is the mean of those of the systems."""
    beside = np.hstack([np.eye(systems[0].n_outputs)] * len(systems)) / np.sqrt(len(systems))
    return gain(beside, systems[0].dt) @ block_diagonal(systems)


def least_error(problem: ObserverProblem, disturbance: StateSpace, remainder: StateSpace | None) -> float:
    """Return the norm of ``W_p e`` that no observer is below, for disturbances of unit power; zero if unknown."""
    plant = shaped_plant(problem, *disturbed(problem, disturbance, remainder))
    squared = predictor_bound(plant.A, plant.B1, plant.C2, plant.D21, plant.C1)
    return float(np.sqrt((squared + np.sum(plant.D11**2)) * (1 - ROUNDING))) if squared > 0 else 0.0
