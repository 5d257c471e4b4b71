r"""Worst-case H2 observers: filtering of a shaped disturbance, by one Riccati equation.

K is outside the loop of the uncertainty, so the worst case over the set is a disturbance spectrum, and the best K for a given spectrum is a
Kalman predictor (state injection) or an H2 controller (input injection). The game between K and the spectrum is solved by fictitious play:
start from the average spectrum of the set, find the
spectrum that is worst for the resulting K, then for the next, and average these. Every iterate is certified
independently, the best is kept; every averaged spectrum gives a lower bound, the best is kept.

*State injection.* With ``d = C_d x_d + D_d nu``, ``x_d+ = A_d x_d + B_d nu`` the shaped input disturbance, and ``r`` the shaped remainder,
the error is ``e = xi + r``, ``xi+ = A xi + B d - y^c``, ``y = C e + n``. The correction has full authority over the state, so the optimum keeps
the predicted error at zero:

    y^c = B C_d x_d^ + (C_r A_r - A C_r) x_r^ + (L_xi + C_r L_r) y,        x_d^+ = A_d x_d^ + L_d y,    x_r^+ = A_r x_r^ + L_r y

with ``L`` the gain of the steady-state predictor of ``(xi, x_d, x_r)``. The order of K is that of the shaping filters only. A performance
weight with states of its own makes past errors matter, which a predictor cannot mend: then, as for input injection, the H2 controller of the
whole plant is taken.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.norms import h2_norm
from ..problem.observer_problem import ObserverProblem
from ..result import Injection, Status, Synthesis
from ..riccati.constant_gain import predictor
from ..riccati.h2_optimal import h2
from .causal import causal_h2
from .certificate import certify
from .disturbance import Channels, Fit, Shaping, default_fit, design_grid, symmetric

Array = npt.NDArray[Any]


def worst_case_h2(
    problem: ObserverProblem,
    *,
    order: int | None = None,
    max_order: int = 4,
    tolerance_db: float = 1.0,
    refinements: int = 1,
    rtol: float = 1e-5,
    fit: Fit | None = None,
    causal: bool = True,
    bounded: bool = True,
) -> Synthesis:
    """Return an observer filter with a certified H2 norm for every member of the uncertain set.

    Parameters
    ----------
    problem : ObserverProblem
    order : int, optional
        Order of each shaping filter; default the smallest within `tolerance_db`, up to `max_order`.
    max_order : int
    tolerance_db : float
        Accuracy of the shaping filters. It costs optimality, never validity: the certificate uses the set itself.
    refinements : int
        Rounds of fictitious play after the first design.
    rtol : float
        Accuracy of the certificate's quadrature.
    fit : callable, optional
        ``fit(freqs_hz, magnitude, dt, order=, max_order=, tolerance_db=, side=)`` with a result whose ``.system`` is a filter; default
        `kros.uncertainty.fit_magnitude`.
    causal : bool
        Estimate the worst causal perturbation as well.
    bounded : bool
        False: only the first design, neither certified nor bounded from below, for those who design many and compare them on recordings.

    Returns
    -------
    Synthesis
        ``worst_case_h2`` with ``quadrature_error`` included, ``lower_bound`` for all observers of either injection, and their gap; ``h2_norm``
        is the norm of the error under measurement and process noise alone (the nominal machine), ``causal_h2`` the largest norm that was found
        for a causal perturbation: the truth for those lies between it and ``worst_case_h2``.

    Raises
    ------
    SynthesisError
        When the set is not well posed, the pair undetectable, a model unstable, or a design does not survive verification.
    """
    problem.require_sound()
    fit = fit or default_fit()
    options = {"order": order, "max_order": max_order, "tolerance_db": tolerance_db}
    channels, sharp = Channels(problem, design_grid(problem)), symmetric(problem)
    spectrum = channels.average()
    if not bounded:
        return _design_alone(problem, channels.shaping(spectrum, fit, "above", options))
    sound = spectrum if sharp else channels.below_average()  # what lower bounds are made of
    best: tuple[float, float, StateSpace] | None = None
    lower, elapsed = 0.0, 0.0
    for round_ in range(refinements + 1):
        shaping = channels.shaping(spectrum, fit, "above", options)
        start = time.perf_counter()
        controller = design(problem, shaping)
        elapsed += time.perf_counter() - start
        value, error = certify(problem, controller, rtol)
        if best is None or value < best[0]:
            best = (value, error, controller)
        lower = max(lower, lower_bound(problem, channels.lowered(shaping, spectrum if sharp else sound)))
        if round_ < refinements:
            spectrum = spectrum.mixed_with(channels.worst(controller), 1 / (round_ + 1))
    assert best is not None
    final = spectrum if sharp else sound
    below = channels.shaping(final, fit, "below", options)
    lower = max(lower, lower_bound(problem, channels.lowered(below, final)))
    return _result(problem, best, lower, elapsed / (refinements + 1), causal)


def _design_alone(problem: ObserverProblem, shaping: Shaping) -> Synthesis:
    controller = design(problem, shaping)
    radius = float(problem.error_system(controller).spectral_radius())
    if radius >= 1:
        raise SynthesisError(
            f"Worst-case H2 synthesis: the loop has spectral radius {radius:.9g}; add noise, or lower the order of the weights."
        )
    notes = ("A design alone, without certificate.",)
    return Synthesis(
        "worst_case_h2", controller, Status.INACCURATE, problem.injection, spectral_radius=radius, solver="riccati", notes=notes
    )


def _result(problem: ObserverProblem, best: tuple[float, float, StateSpace], lower: float, elapsed: float, causal: bool) -> Synthesis:
    value, error, controller = best
    loop = problem.error_system(controller)
    n_d = problem.nominal.n_inputs + problem.nominal.n_states
    return Synthesis(
        method="worst_case_h2",
        controller=controller,
        status=Status.CERTIFIED,
        injection=problem.injection,
        h2_norm=h2_norm(StateSpace(loop.A, loop.B[:, n_d:], loop.C, loop.D[:, n_d:], loop.dt)),
        worst_case_h2=value,
        causal_h2=causal_h2(problem, controller) if causal else None,
        lower_bound=lower,
        gap_percent=100 * (value / lower - 1) if lower else None,
        quadrature_error=error,
        spectral_radius=float(loop.spectral_radius()),
        solve_s=elapsed,
        solver="riccati",
        notes=("The spectral radius is that of the nominal loop; it says nothing about robustness. The certificate is worst_case_h2.",),
    )


def design(problem: ObserverProblem, shaping: Shaping) -> StateSpace:
    """Return the filter that is H2-optimal for the shaped disturbances, in physical units."""
    ports = shaping.ports(problem)
    if problem.injection is Injection.INPUT or problem.performance.n_states:
        return problem.to_physical(h2(problem.shaped_plant(*ports), problem.injection).controller)
    K, _ = _shaped_kalman(problem, *ports)
    return problem.to_physical(K)


def lower_bound(problem: ObserverProblem, shaping: Shaping) -> float:
    """Return a worst-case H2 norm that no observer of either injection beats, for filters that lie below the spectrum on the grid.

    The Kalman optimum is the bound. State injection contains input injection (``K_state = B K_input``), and an observer's ``W_p x_hat`` is one
    of the causal estimates of ``W_p x`` over which the Kalman predictor is the best.
    """
    return _shaped_kalman(problem, *shaping.ports(problem))[1]


def _shaped_kalman(problem: ObserverProblem, d: StateSpace, r: StateSpace) -> tuple[StateSpace, float]:
    """Best predictor for shaped disturbances at the input and at the state: its filter for state injection, scaled, and the norm it reaches."""
    A, B, C, D_p = problem.scaled
    n, q, p = A.shape[0], C.shape[0], problem.performance
    kd, kr, kp = d.n_states, r.n_states, p.n_states
    to_error = np.hstack([np.eye(n), np.zeros((n, kd)), r.C, np.zeros((n, kp))])
    feed = np.hstack([np.zeros((n, d.n_inputs)), r.D])  # white part of e
    A_s = np.block(
        [
            [A, B @ d.C, np.zeros((n, kr + kp))],
            [np.zeros((kd, n)), d.A, np.zeros((kd, kr + kp))],
            [np.zeros((kr, n + kd)), r.A, np.zeros((kr, kp))],
            [p.B @ to_error[:, : n + kd + kr], p.A],
        ]
    )
    B_s = np.block(
        [[B @ d.D, np.zeros((n, r.n_inputs))], [d.B, np.zeros((kd, r.n_inputs))], [np.zeros((kr, d.n_inputs)), r.B], [p.B @ feed]]
    )
    C_s, D_s = C @ to_error, C @ feed
    Q_s = B_s @ B_s.T
    Q_s[:n, :n] += np.diag(problem.scaled_process_noise**2)
    L, P = predictor(A_s, C_s, Q_s, np.eye(q) + D_s @ D_s.T, B_s @ D_s.T, "Worst-case H2 synthesis")
    L_xi, L_d, L_r = L[:n], L[n : n + kd], L[n + kd : n + kd + kr]
    K = StateSpace(
        np.block([[d.A, np.zeros((kd, kr))], [np.zeros((kr, kd)), r.A]]),
        np.vstack([L_d, L_r]),
        np.hstack([B @ d.C, r.C @ r.A - A @ r.C]),
        L_xi + r.C @ L_r,
        d.dt,
    )
    z, z_feed = D_p @ to_error, D_p @ feed
    z[:, n + kd + kr :] = p.C
    return K, float(np.sqrt(max(np.trace(z @ P @ z.T) + np.sum(z_feed**2), 0.0)))
