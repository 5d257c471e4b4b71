r"""Does the certificate hold for the units it was made from? Errors of their models against the bounds.

For the model of every unit, without noise,

.. math:: e = S\,(G_p - G)\,W_u w_1: \qquad x_p^+ = A_p x_p + B_p s, \quad
          e^+ = A e + (A_p - A)\,x_p + (B_p - B)\,s - J u, \quad u = K C e

so that no difference of large responses is formed. Nothing here knows of forms, weights or balls.

Symbols
-------
s : scaled input;  e : error;  x_p : state of the unit
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...core.norms import h2_norm
from ...core.rounding import TINY
from ..problem.interconnect import interconnect
from ..problem.observer_problem import ObserverProblem
from .certificate import certify, density
from .disturbance import design_grid

Array = npt.NDArray[Any]


def unit_ratios(problem: ObserverProblem, controller: StateSpace, units: StateSpace) -> tuple[Array, Array]:
    """Return errors over bounds of every unit's model, (unit,): of norms, and the largest of root densities."""
    n, m = problem.nominal.n_states, problem.nominal.n_inputs
    errors = [unit_error(problem, controller, A, B) for A, B in zip(units.A, units.B, strict=True)]
    freqs, loop = design_grid(problem), problem.error_system(controller)
    noise = loop.frequency_response(freqs)[..., m + n :]
    bound = np.sqrt(np.maximum(density(problem, loop, freqs) - np.sum(np.abs(noise) ** 2, axis=(-2, -1)), 0.0))
    size = [np.linalg.norm(e.frequency_response(freqs), axis=(-2, -1)) for e in errors]
    norms = np.array([h2_norm(e) for e in errors]) / certify(problem, controller)[0]
    return norms, np.array([np.max(s / np.maximum(bound, TINY)) for s in size])


def unit_error(problem: ObserverProblem, controller: StateSpace, A_p: Array, B_p: Array) -> StateSpace:
    """Return the system from w1 to ``W_p (x - x_hat)`` for one unit, given in physical units, without noise."""
    A, B, C, W_p = problem.scaled
    x, u = problem.output_scale, problem.input_scale
    n, eye, dt = len(A), np.eye(len(A)), problem.nominal.dt
    A_p, B_p = A_p * x / x[:, None], B_p * u / x[:, None]
    blocks = {
        "unit": StateSpace(A_p, eye, eye, np.zeros((n, n)), dt),
        "error": StateSpace(A, eye, eye, np.zeros((n, n)), dt),
        "K": problem.to_scaled(controller),
        "W_u": problem.input_weight,
    }
    w1 = problem.input_weight.n_inputs
    wires = {
        "unit": {"W_u": B_p},
        "error": {"unit": A_p - A, "W_u": B_p - B, "K": -problem.injection_matrix},
        "K": {"error": C},
        "W_u": {"w1": np.eye(w1)},
    }
    return interconnect(blocks, wires, {"w1": w1}, {"z1": {"error": W_p}})
