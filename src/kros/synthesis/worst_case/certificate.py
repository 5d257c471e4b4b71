r"""Certified worst-case H2 norm of an observer, for any correction filter, however it was found.

.. math::
    \frac{1}{2\pi}\int \Big(b_\Delta(\theta) + b_r(\theta)\Big)^2 + \|T_n\|_F^2 \, d\theta

``b_Delta`` bounds ``||T X M||_F`` over the matrix ball (`ball`), ``b_r`` the additive remainder, a ball around zero; it
adds by the triangle inequality since the same input drives both. The noise is independent, so its square adds. Delta is
any frequency-wise contraction, causal or not: the bound is for that set, and an upper bound for causal perturbations.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.norms import h2_norm
from ..problem.observer_problem import ObserverProblem
from ..result import Status, Synthesis
from .ball import spread, uncertain_ball
from .quadrature import circle_mean

Array = npt.NDArray[Any]


def density(problem: ObserverProblem, loop: StateSpace, freqs_hz: Array) -> Array:
    """Certified worst-case power density of ``W_p e``, shape (f,), for the closed error system `loop`."""
    m, n = problem.nominal.n_inputs, problem.nominal.n_states
    response = loop.frequency_response(freqs_hz)
    T = response[..., problem.uncertainty_input] @ problem.W_L.frequency_response(freqs_hz)
    uncertain = uncertain_ball(problem, freqs_hz).bound(T)
    if problem.remainder_left is not None and problem.remainder_right is not None:
        left = response[..., m : m + n] @ problem.remainder_left.frequency_response(freqs_hz)
        uncertain = uncertain + spread(
            left, (problem.remainder_right @ problem.input_weight).frequency_response(freqs_hz)
        )
    return uncertain**2 + np.sum(np.abs(response[..., m + n :]) ** 2, axis=(-2, -1))


def certify(problem: ObserverProblem, controller: StateSpace, rtol: float = 1e-5) -> tuple[float, float]:
    """Return the certified worst-case H2 norm of ``W_p e`` and the quadrature error that it includes."""
    problem.require_sound()
    loop = problem.error_system(controller)
    if not loop.is_stable():
        raise SynthesisError(
            f"Certificate: the nominal observer loop has spectral radius {float(loop.spectral_radius()):.9g}; no "
            "bound is finite."
        )
    dt = problem.nominal.dt
    squared, error = circle_mean(
        lambda theta: density(problem, loop, theta / (2 * np.pi * dt)), _log_poles(problem, loop), rtol
    )
    upper = float(np.sqrt(squared + error))
    return upper, upper - float(np.sqrt(squared))


def certified(problem: ObserverProblem, controller: StateSpace, method: str, rtol: float = 1e-5) -> Synthesis:
    """Return a controller in physical units with its certificate.

    ``h2_norm`` is that of measurement and process noise alone.
    """
    value, error = certify(problem, controller, rtol)
    loop, white = problem.error_system(controller), problem.nominal.n_inputs + problem.nominal.n_states
    return Synthesis(
        method=method,
        controller=controller,
        status=Status.CERTIFIED,
        injection=problem.injection,
        h2_norm=h2_norm(StateSpace(loop.A, loop.B[:, white:], loop.C, loop.D[:, white:], loop.dt)),
        worst_case_h2=value,
        quadrature_error=error,
        spectral_radius=loop.largest_pole(),
        solver="riccati",
    )


def _log_poles(problem: ObserverProblem, loop: StateSpace) -> Array:
    """Logarithms of all poles, in the upper half plane."""
    systems = [loop, problem.W_L, problem.M, problem.N, problem.remainder_left, problem.remainder_right]
    poles = np.concatenate([s.poles() for s in systems if s is not None]).astype(complex)
    poles = poles[(poles.imag >= 0) & (np.abs(poles) > 1e-3)]
    return np.log(poles)
