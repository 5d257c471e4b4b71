"""The set as a disturbance: rational filters that shape white noise like the average over the set.

The disturbance is ``W_L w2`` and acts at the input or at the state. Where W_L is diagonal one filter a channel stands
for W_L and the spectrum of w2 together, which takes fewer states; a full W_L stays as it is behind one filter for every
component of w2.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ...core import AnyArray, StateSpace, block_diagonal
from ...uncertainty import fit_magnitude
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import disturbed
from .ball import uncertain_ball

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
