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

*The set as a disturbance*: rational filters that shape white noise like the average over the set.

The disturbance is ``W_L w2`` and acts at the input or at the state. Where W_L is diagonal one filter a channel stands
for W_L and the spectrum of w2 together, which takes fewer states; a full W_L stays as it is behind one filter for every
component of w2.

*Lower bound*: no observer does better on members of the set that are systems.

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
from dataclasses import replace
from functools import partial

import numpy as np

from ...core import ROUNDING, AnyArray, StateSpace, block_diagonal, gain, h2_norm
from ...uncertainty import fit_magnitude
from ..generalized_plant import interconnect
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import disturbed, shaped_plant
from ..result import Injection, Status, Synthesis, enclosed
from ..riccati.h2 import predictor, predictor_bound
from .ball import uncertain_ball
from .certificate import certify_errors

_FLOOR, _NOTHING = 1e-14, 1e-30  # relative power below which a channel is level; power of a channel that is absent


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
        ``worst_case_h2``, an upper bound, ``lower_bound`` for all observers of either injection, and
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
    return Synthesis(
        method=method,
        controller=controller,
        status=Status.CERTIFIED,
        injection=problem.injection,
        h2_norm=h2_norm(loop @ gain(np.eye(loop.n_inputs)[:, white:], loop.dt)),
        worst_case_h2=certify_errors(problem, loop),
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


def average_disturbance(problem: ObserverProblem, max_order: int, tolerance_db: float) -> tuple[StateSpace, StateSpace]:
    """Return filters that shape white noise like the average over the set, at the input and at the state."""
    freqs = design_grid(problem)
    power = np.real(np.einsum("fii->fi", uncertain_ball(problem, freqs).average()))  # of w2
    left, dt = np.abs(problem.W_L.frequency_response(freqs)) ** 2, problem.nominal.dt
    of = partial(filters, freqs_hz=freqs, dt=dt, max_order=max_order, tolerance_db=tolerance_db)
    if left.shape[1] == left.shape[2] and not left[:, ~np.eye(left.shape[1], dtype=bool)].any():
        shaped = of(np.sum(left, axis=-1) * power)
    else:
        shaped = problem.W_L @ of(power)
    if problem.remainder is None:
        return disturbed(problem, shaped, None)
    left, right = (np.abs(side.frequency_response(freqs)) ** 2 for side in problem.remainder)
    energy = right.sum(axis=(-2, -1)) / max(left.shape[-1], right.shape[-2])
    return disturbed(problem, shaped, of(left.sum(axis=-1) * energy[:, None]))


def design_grid(problem: ObserverProblem) -> AnyArray:
    """Frequencies for the design, Hz: logarithmic from well below the slowest pole to Nyquist."""
    dt = problem.nominal.dt
    systems = [problem.nominal, problem.W_L, problem.W_R, problem.input_weight]
    slowest = np.abs(np.concatenate([s.poles() for s in systems]) - 1).min(initial=1.0)
    return np.geomspace(min(max(slowest / 30, 1e-7), 1e-2), np.pi, 400) / (2 * np.pi * dt)  # 400 points


def filters(power: AnyArray, freqs_hz: AnyArray, dt: float, max_order: int, tolerance_db: float) -> StateSpace:
    """Return one filter a channel, whose magnitude touches the root of its power, shape (f, channels), from above."""
    largest = power.max(axis=0)
    power = np.where(largest > _NOTHING, np.maximum(power, _FLOOR * largest), 0.0)
    fit = partial(fit_magnitude, max_order=max_order, tolerance_db=tolerance_db)
    return block_diagonal([fit(freqs_hz, column, dt).system for column in np.sqrt(power).T])


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
