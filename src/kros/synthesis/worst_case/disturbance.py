r"""The set as a disturbance: rational filters that shape white noise like the average over the set.

The disturbance is ``W_L w2`` and acts at the input or at the state. Where W_L is diagonal one filter a channel stands
for W_L and the spectrum of w2 together, which takes fewer states; a full W_L stays as it is behind one filter for every
component of w2.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...core.arrays import AnyArray
from ...core.lti import StateSpace, block_diagonal, gain
from ...core.rounding import ROUNDING
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import disturbed
from .ball import uncertain_ball

Fit = Callable[..., Any]

_FLOOR, _NOTHING = 1e-14, 1e-30  # relative power below which a channel is level; power of a channel that is absent


def average_disturbance(problem: ObserverProblem, fit: Fit) -> tuple[StateSpace, StateSpace]:
    """Return filters that shape white noise like the average over the set, at the input and at the state."""
    freqs = design_grid(problem)
    power = np.real(np.einsum("fii->fi", uncertain_ball(problem, freqs).average()))  # of w2
    if is_diagonal(problem.W_L):
        left = np.abs(problem.W_L.frequency_response(freqs)) ** 2
        shaped = filters(np.sum(left, axis=-1) * power, freqs, problem.nominal.dt, fit)
    else:
        shaped = problem.W_L @ filters(power, freqs, problem.nominal.dt, fit)
    rest = _remainder(problem, freqs)
    return disturbed(problem, shaped, None if rest is None else filters(rest, freqs, problem.nominal.dt, fit))


def design_grid(problem: ObserverProblem, count: int = 400) -> AnyArray:
    """Frequencies for the design, Hz: logarithmic from well below the slowest pole to Nyquist."""
    dt = problem.nominal.dt
    systems = [problem.nominal, problem.W_L, problem.W_R, problem.input_weight]
    slowest = np.abs(np.concatenate([s.poles() for s in systems]) - 1).min(initial=1.0)
    return np.geomspace(min(max(slowest / 30, 1e-7), 1e-2), np.pi, count) / (2 * np.pi * dt)


def is_diagonal(system: StateSpace) -> bool:
    """Tell whether the system is square and its off-diagonal transfer functions vanish (Markov parameters)."""
    if system.n_outputs != system.n_inputs:
        return False
    off = ~np.eye(system.n_outputs, dtype=bool)
    block, size = system.B, float(np.abs(system.C).max(initial=0) * np.abs(system.B).max(initial=0))
    if np.any(system.D[off]):
        return False
    for _ in range(2 * system.n_states):
        if np.any(np.abs((system.C @ block)[off]) > ROUNDING * size):
            return False
        block = system.A @ block
    return True


def _remainder(problem: ObserverProblem, freqs_hz: AnyArray) -> AnyArray | None:
    """Average spectrum of the remainder, shape (f, n)."""
    if problem.remainder_left is None or problem.remainder_right is None:
        return None
    left = problem.remainder_left.frequency_response(freqs_hz)
    right = (problem.remainder_right @ problem.input_weight).frequency_response(freqs_hz)
    energy = np.sum(np.abs(right) ** 2, axis=(-2, -1)) / max(left.shape[-1], right.shape[-2])
    return np.sum(np.abs(left) ** 2, axis=-1) * energy[:, None]


def filters(power: AnyArray, freqs_hz: AnyArray, dt: float, fit: Fit) -> StateSpace:
    """Return one filter a channel, whose magnitude touches the root of its power, shape (f, channels), from above."""
    systems = []
    for column in power.T:
        if column.max() <= _NOTHING:
            systems.append(gain([[0.0]], dt))
            continue
        magnitude = np.sqrt(np.maximum(column, _FLOOR * column.max()))
        system = fit(freqs_hz, magnitude / magnitude.max(), dt).system
        ratio = magnitude / np.abs(system.frequency_response(freqs_hz)[:, 0, 0])
        systems.append(gain([[float(ratio.max())]], dt) @ system)
    return block_diagonal(systems)
