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

The lower bound is in `lower_bound`.

Lower bound of the worst case over the set: no observer does better on members of the set that are systems.

A constant contraction :math:`\Delta_i` gives a member of the set. On it the error is driven by the system ``D_i = W_L
Delta_i (I - N Delta_i)^-1 M``, and the least error of any observer is the optimum of a Riccati equation. The worst case
over the set is at least that, and at least the mean over some members: as the same observer meets all of them, the mean
is the optimum for ``[D_1 ... D_k] / sqrt(k)``, driven by independent white noises. Nothing depends on a grid. State
injection contains input injection (``K_state = B K_input``), and an observer's ``W_p x_hat`` is one of the causal
estimates of ``W_p x`` over which a predictor is the best.

The additive remainder has members of its own. Their mean is taken over both signs, so that the powers of remainder and
perturbation add.

The set as a disturbance: rational filters that shape white noise like the average over the set.

The disturbance is ``W_L w2`` and acts at the input or at the state. Where W_L is diagonal one filter a channel stands
for W_L and the spectrum of w2 together, which takes fewer states; a full W_L stays as it is behind one filter for every
component of w2.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from ...core import ROUNDING, AnyArray, StateSpace, SynthesisError, block_diagonal, gain
from ...uncertainty import fit_magnitude
from ..generalized_plant import interconnect
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import disturbed, shaped_plant
from ..result import Injection, Status, Synthesis, enclosed
from ..riccati.h2 import predictor, predictor_bound
from .certificate import certified, uncertain_ball


def worst_case_h2(
    problem: ObserverProblem,
    *,
    max_order: int = 4,
    tolerance_db: float = 1.0,
    bounded: bool = True,
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
    bounded : bool
        False: only the design, neither certified nor bounded from below, for those who design many and compare them on
        recordings.

    Returns
    -------
    Synthesis
        ``worst_case_h2`` with ``quadrature_error`` included, ``lower_bound`` for all observers of either injection, and
        their gap; ``h2_norm`` is the norm of the error under measurement and process noise alone (the nominal machine).

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
    start = time.perf_counter()
    controller = design(problem, *shaped)
    elapsed = time.perf_counter() - start
    if not bounded:
        radius = problem.error_system(controller).largest_pole()
        if radius >= 1:
            loop = f"the loop has spectral radius {radius:.9g}"
            raise SynthesisError(f"Worst-case H2 synthesis: {loop}; add noise, or lower the order of the weights.")
        about = Status.INACCURATE, problem.injection
        alone = Synthesis("worst_case_h2", controller, *about, spectral_radius=radius, solver="riccati")
        return replace(alone, notes=("A design alone, without certificate.",))
    candidates = [certified(problem, K, "worst_case_h2") for K in (problem.nothing, controller)]
    best = min(candidates, key=lambda candidate: candidate.worst_case_h2 or 0.0)
    lower, gap, notes = enclosed(best.worst_case_h2 or 0.0, lower_bound(problem))
    note = "The spectral radius is that of the nominal loop and says nothing about robustness, worst_case_h2 does."
    return replace(best, lower_bound=lower, gap_percent=gap, solve_s=elapsed, notes=(note, *notes))


def design(problem: ObserverProblem, d: StateSpace, r: StateSpace) -> StateSpace:
    """Return the filter that is H2-optimal for shaped disturbances of input and state, in physical units."""
    plant = shaped_plant(problem, d, r)
    A, B, _, _ = problem.scaled
    n, kd = len(A), d.n_states
    noises = plant.B1 @ plant.B1.T, plant.D21 @ plant.D21.T, plant.B1 @ plant.D21.T
    L, _ = predictor(plant.A, plant.C2, *noises, "Worst-case H2 synthesis")
    output = np.hstack([B @ d.C, r.C @ r.A - A @ r.C])
    return problem.to_physical(StateSpace(block_diagonal([d, r]).A, L[n:], output, L[:n] + r.C @ L[n + kd :], d.dt))


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
    b, a = delta.shape
    blocks = {"M": problem.M, "N": problem.N, "Delta": gain(delta, problem.nominal.dt), "W_L": problem.W_L}
    done, seen = {"Delta": np.eye(b)}, {"M": np.eye(a), "N": np.eye(a)}
    wires = {"M": {"w1": np.eye(problem.M.n_inputs)}, "N": done, "Delta": seen, "W_L": done}
    outputs = {"d": {"W_L": np.eye(problem.W_L.n_outputs)}}
    return interconnect(blocks, wires, {"w1": problem.M.n_inputs}, outputs)


def mean(systems: Sequence[StateSpace]) -> StateSpace:
    """Return ``[D_1 ... D_k] / sqrt(k)``, whose power is the mean of those of the systems."""
    beside = np.hstack([np.eye(systems[0].n_outputs)] * len(systems)) / np.sqrt(len(systems))
    return gain(beside, systems[0].dt) @ block_diagonal(systems)


def least_error(problem: ObserverProblem, disturbance: StateSpace, remainder: StateSpace | None) -> float:
    """Return the norm of ``W_p e`` that no observer is below, for disturbances of unit power; zero if unknown."""
    plant = shaped_plant(problem, *disturbed(problem, disturbance, remainder))
    squared = predictor_bound(plant.A, plant.B1, plant.C2, plant.D21, plant.C1)
    return float(np.sqrt((squared + np.sum(plant.D11**2)) * (1 - ROUNDING))) if squared > 0 else 0.0


_FLOOR, _NOTHING = 1e-14, 1e-30  # relative power below which a channel is level; power of a channel that is absent


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
    rest = _remainder(problem, freqs)
    return disturbed(problem, shaped, None if rest is None else of(rest))


def design_grid(problem: ObserverProblem) -> AnyArray:
    """Frequencies for the design, Hz: logarithmic from well below the slowest pole to Nyquist."""
    dt = problem.nominal.dt
    systems = [problem.nominal, problem.W_L, problem.W_R, problem.input_weight]
    slowest = np.abs(np.concatenate([s.poles() for s in systems]) - 1).min(initial=1.0)
    return np.geomspace(min(max(slowest / 30, 1e-7), 1e-2), np.pi, 400) / (2 * np.pi * dt)  # 400 points


def _remainder(problem: ObserverProblem, freqs_hz: AnyArray) -> AnyArray | None:
    """Average spectrum of the remainder, shape (f, n)."""
    if problem.remainder is None:
        return None
    left, right = (side.frequency_response(freqs_hz) for side in problem.remainder)
    energy = np.sum(np.abs(right) ** 2, axis=(-2, -1)) / max(left.shape[-1], right.shape[-2])
    return np.sum(np.abs(left) ** 2, axis=-1) * energy[:, None]


def filters(power: AnyArray, freqs_hz: AnyArray, dt: float, max_order: int, tolerance_db: float) -> StateSpace:
    """Return one filter a channel, whose magnitude touches the root of its power, shape (f, channels), from above."""
    systems = []
    for column in power.T:
        if column.max() <= _NOTHING:
            systems.append(gain([[0.0]], dt))
            continue
        magnitude = np.sqrt(np.maximum(column, _FLOOR * column.max()))
        shape = (magnitude / magnitude.max()).tobytes()
        system = _fitted(freqs_hz.tobytes(), shape, dt, max_order, tolerance_db)
        ratio = magnitude / np.abs(system.frequency_response(freqs_hz)[:, 0, 0])
        systems.append(gain([[float(ratio.max())]], dt) @ system)
    return block_diagonal(systems)


@lru_cache(maxsize=100)
def _fitted(freqs_hz: bytes, magnitude: bytes, dt: float, max_order: int, tolerance_db: float) -> StateSpace:
    """Return the system of a fit; problems that differ in noise alone share it."""
    values = np.frombuffer(freqs_hz), np.frombuffer(magnitude)
    return fit_magnitude(*values, dt, max_order=max_order, tolerance_db=tolerance_db).system
