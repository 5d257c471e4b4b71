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

with ``L`` the gain of the steady-state predictor of ``(xi, x_d, x_r)``. The order of K is that of the shaping filters only.

Symbols
-------
phi : diagonal of the disturbance's spectrum after W_L, shape (f, m);  psi : the same for the remainder, shape (f, n)
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import SynthesisError
from ..core.lti import StateSpace, block_diagonal
from ..core.norms import h2_norm
from .certificate import certify, uncertain_ball
from .constant_gain import predictor
from .h2_optimal import h2
from .observer_problem import ObserverProblem, is_diagonal
from .result import Injection, Status, Synthesis

Array = npt.NDArray[Any]
Fit = Callable[..., Any]

_GRID = 400
_FLOOR = 1e-14


@dataclass(frozen=True, eq=False)
class _Spectrum:
    """Spectrum of the disturbances on the design grid: input channels phi (f, m), remainder channels psi (f, n) or None."""

    phi: Array
    psi: Array | None


@dataclass(frozen=True, eq=False)
class _Shaping:
    """Rational factors of a spectrum, one per channel."""

    disturbance: StateSpace
    remainder: StateSpace | None


def worst_case_h2(
    problem: ObserverProblem,
    *,
    order: int | None = None,
    max_order: int = 4,
    tolerance_db: float = 1.0,
    refinements: int = 1,
    rtol: float = 1e-5,
    fit: Fit | None = None,
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
        `kros.uncertainty.fit.fit_magnitude`.

    Returns
    -------
    Synthesis
        ``worst_case_h2`` with ``quadrature_error`` included, ``lower_bound`` for all observers of either injection, and their gap; ``h2_norm``
        is the norm of the error under measurement and process noise alone (the nominal machine).

    Raises
    ------
    SynthesisError
        When the set is not well posed, the pair undetectable, a model unstable, or a design does not survive verification.
    """
    problem.require_sound()
    fit = fit or _default_fit()
    options = {"order": order, "max_order": max_order, "tolerance_db": tolerance_db}
    freqs = design_grid(problem)
    spectrum = average_spectrum(problem, freqs)
    best: tuple[float, float, StateSpace] | None = None
    lower, elapsed, diagonal = 0.0, 0.0, is_diagonal(problem.input_weight)
    for round_ in range(refinements + 1):
        shaping = fit_spectrum(problem, freqs, spectrum, fit, "above", options)
        start = time.perf_counter()
        controller = design(problem, shaping)
        elapsed += time.perf_counter() - start
        value, error = certify(problem, controller, rtol)
        if best is None or value < best[0]:
            best = (value, error, controller)
        if diagonal:
            lower = max(lower, lower_bound(problem, freqs, spectrum, shaping))
        if round_ < refinements:
            spectrum = _mix(spectrum, worst_spectrum(problem, freqs, controller), 1 / (round_ + 1))
    assert best is not None
    if diagonal:
        below = fit_spectrum(problem, freqs, spectrum, fit, "below", options)
        lower = max(lower, lower_bound(problem, freqs, spectrum, below))
    return _result(problem, best, lower if diagonal else None, elapsed / (refinements + 1))


def _result(problem: ObserverProblem, best: tuple[float, float, StateSpace], lower: float | None, elapsed: float) -> Synthesis:
    value, error, controller = best
    loop = problem.error_system(controller)
    n_d = problem.nominal.n_inputs + problem.nominal.n_states
    notes = ["The spectral radius is that of the nominal loop; it says nothing about robustness. The certificate is worst_case_h2."]
    if lower is None:
        notes.append("No lower bound: it needs a diagonal W_u.")
    return Synthesis(
        method="worst_case_h2",
        controller=controller,
        status=Status.CERTIFIED,
        injection=problem.injection,
        h2_norm=h2_norm(StateSpace(loop.A, loop.B[:, n_d:], loop.C, loop.D[:, n_d:], loop.dt)),
        worst_case_h2=value,
        lower_bound=lower,
        gap_percent=100 * (value / lower - 1) if lower else None,
        quadrature_error=error,
        spectral_radius=float(loop.spectral_radius()),
        solve_s=elapsed,
        solver="riccati",
        notes=tuple(notes),
    )


def _default_fit() -> Fit:
    from ..uncertainty.fit import fit_magnitude

    return fit_magnitude


def design_grid(problem: ObserverProblem) -> Array:
    """Frequencies for the design, Hz: logarithmic from well below the slowest pole to Nyquist."""
    dt = problem.nominal.dt
    systems = [problem.nominal, problem.W_L, problem.W_R, problem.input_weight]
    poles = np.concatenate([s.poles() for s in systems])
    slowest = np.abs(poles - 1).min(initial=1.0)
    return np.geomspace(min(max(slowest / 30, 1e-7), 1e-2), np.pi, _GRID) / (2 * np.pi * dt)


def average_spectrum(problem: ObserverProblem, freqs_hz: Array) -> _Spectrum:
    """Average of the disturbance's spectrum over the set; every causal observer costs at least its share of it."""
    left = np.sum(np.abs(problem.W_L.frequency_response(freqs_hz)) ** 2, axis=-1)
    return _Spectrum(left * uncertain_ball(problem, freqs_hz).average(), _remainder_spectrum(problem, freqs_hz))


def worst_spectrum(problem: ObserverProblem, freqs_hz: Array, controller: StateSpace) -> _Spectrum:
    """Spectrum of the element of the set that is (locally) worst for a given observer."""
    left = problem.W_L.frequency_response(freqs_hz)
    T = problem.error_system(controller).frequency_response(freqs_hz)[..., : problem.nominal.n_inputs] @ left
    phi = np.sum(np.abs(left) ** 2, axis=-1) * uncertain_ball(problem, freqs_hz).worst_spectrum(T)
    return _Spectrum(phi, _remainder_spectrum(problem, freqs_hz))


def _remainder_spectrum(problem: ObserverProblem, freqs_hz: Array) -> Array | None:
    """Average spectrum of the remainder, shape (f, n)."""
    if problem.remainder_left is None or problem.remainder_right is None:
        return None
    left = problem.remainder_left.frequency_response(freqs_hz)
    right = problem.remainder_right.frequency_response(freqs_hz) @ problem.input_weight.frequency_response(freqs_hz)
    energy = np.sum(np.abs(right) ** 2, axis=(-2, -1)) / max(left.shape[-1], right.shape[-2])
    return np.sum(np.abs(left) ** 2, axis=-1) * energy[:, None]


def _mix(one: _Spectrum, other: _Spectrum, weight: float) -> _Spectrum:
    return _Spectrum((1 - weight) * one.phi + weight * other.phi, one.psi)


def fit_spectrum(problem: ObserverProblem, freqs_hz: Array, spectrum: _Spectrum, fit: Fit, side: str, options: dict[str, Any]) -> _Shaping:
    """Fit one rational factor a channel."""

    def factor(power: Array) -> StateSpace:
        systems = []
        for column in power.T:
            magnitude = np.sqrt(np.maximum(column, _FLOOR * max(column.max(), 1e-300)))
            systems.append(fit(freqs_hz, magnitude, problem.nominal.dt, side=side, **options).system)
        return block_diagonal(systems)

    return _Shaping(factor(spectrum.phi), None if spectrum.psi is None else factor(spectrum.psi))


def design(problem: ObserverProblem, shaping: _Shaping) -> StateSpace:
    """Return the filter that is H2-optimal for the shaped disturbances, in physical units."""
    if problem.injection is Injection.INPUT:
        return problem.to_physical(h2(problem.shaped_plant(shaping.disturbance, shaping.remainder), Injection.INPUT).controller)
    K, _ = _shaped_kalman(problem, shaping)
    return problem.to_physical(K)


def _shaped_kalman(problem: ObserverProblem, shaping: _Shaping) -> tuple[StateSpace, float]:
    """Optimal filter for state injection in scaled coordinates, and the H2 norm of W_p e that it reaches."""
    A, B, C, W_p = problem.scaled
    n, q = A.shape[0], C.shape[0]
    d = shaping.disturbance
    r = shaping.remainder or StateSpace(np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((n, 0)), np.zeros((n, 0)), d.dt)
    kd, kr = d.n_states, r.n_states
    A_s = np.block([[A, B @ d.C, np.zeros((n, kr))], [np.zeros((kd, n)), d.A, np.zeros((kd, kr))], [np.zeros((kr, n + kd)), r.A]])
    B_s = np.block([[B @ d.D, np.zeros((n, r.n_inputs))], [d.B, np.zeros((kd, r.n_inputs))], [np.zeros((kr, d.n_inputs)), r.B]])
    to_error = np.hstack([np.eye(n), np.zeros((n, kd)), r.C])
    feed = np.hstack([np.zeros((n, d.n_inputs)), r.D])  # white part of e
    C_s, D_s = C @ to_error, C @ feed
    Q_s = B_s @ B_s.T
    Q_s[:n, :n] += np.diag(problem.scaled_process_noise**2)
    L, P = predictor(A_s, C_s, Q_s, np.eye(q) + D_s @ D_s.T, B_s @ D_s.T, "Worst-case H2 synthesis")
    L_xi, L_d, L_r = L[:n], L[n : n + kd], L[n + kd :]
    K = StateSpace(
        np.block([[d.A, np.zeros((kd, kr))], [np.zeros((kr, kd)), r.A]]),
        np.vstack([L_d, L_r]),
        np.hstack([B @ d.C, r.C @ r.A - A @ r.C]),
        L_xi + r.C @ L_r,
        d.dt,
    )
    covariance = to_error @ P @ to_error.T + feed @ feed.T
    return K, float(np.sqrt(max(np.trace(W_p @ covariance @ W_p.T), 0.0)))


def lower_bound(problem: ObserverProblem, freqs_hz: Array, spectrum: _Spectrum, shaping: _Shaping) -> float:
    """Return a worst-case H2 norm that no observer of either injection beats.

    The shaping filters are lowered until they lie below the spectrum on the grid; the Kalman optimum of what remains is the bound. State
    injection contains input injection (``K_state = B K_input``), so one bound serves both.
    """
    d = _lowered(shaping.disturbance, freqs_hz, spectrum.phi)
    r = None if shaping.remainder is None or spectrum.psi is None else _lowered(shaping.remainder, freqs_hz, spectrum.psi)
    return _shaped_kalman(problem, _Shaping(d, r))[1]


def _lowered(system: StateSpace, freqs_hz: Array, power: Array) -> StateSpace:
    """Scale each channel of a diagonal filter so that its power nowhere exceeds `power`, shape (f, channels)."""
    found = np.abs(np.diagonal(system.frequency_response(freqs_hz), axis1=-2, axis2=-1)) ** 2
    if not np.isfinite(found).all():
        raise SynthesisError("Worst-case H2 synthesis: a shaping filter has an infinite response; ask for a lower order.")
    ratio = np.min(power / np.maximum(found, 1e-300), axis=0)
    scale = np.sqrt(np.minimum(ratio, 1.0))
    return StateSpace(system.A, system.B, system.C * scale[:, None], system.D * scale[:, None], system.dt)
