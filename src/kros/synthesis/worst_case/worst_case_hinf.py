r"""Worst-case H-infinity observers: H-infinity filtering of a shaped disturbance, whose shape the multipliers give.

For given multipliers the bound of `robust_gain` says how large the disturbance ``w2`` may be: with ``q = ||R_r M||`` and ``t = tau q^2 / gamma^2``,

.. math:: \gamma^2 = \|[T \Psi^{1/2},\ T_r \Psi_r^{1/2},\ T_n]\|^2, \quad
          \Psi = X_c M \Big(I - t \frac{Q^HQ}{q^2} - t_r \frac{Q_r^HQ_r}{q_r^2}\Big)^{-1} M^H X_c^H + \frac{q^2}{t} R_l R_l^H,
          \quad \Psi_r = \frac{q_r^2}{t_r} I

(sums of covariances are sums of quadratic bounds). K is in T alone, so with rational factors of the spectra it is a standard H-infinity problem,
solved by Riccati equations with a search over the level. Without a loop and remainder ``t = 1`` and nothing depends on K: one problem, exact
but for the fit. Otherwise t follows from the K of the round before. Every K is certified independently, the best is kept; no
correction at all is one of them.

*Lower bound.* Theta and -Theta are both in the ball and the norm is convex, so ``||[T X M, T_n]||`` is at least ``||[T R_l q, T_n]||`` for some
member, whatever T. What no causal estimate of ``W_p x`` beats for filters below ``q R_l`` is therefore a bound for every observer; it is the largest
level that was shown to be infeasible.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...core.linalg import adjoint
from ...core.lti import StateSpace, block_diagonal, gain
from ...core.norms import hinf_norm
from ..generalized_plant import GeneralizedPlant
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import shape_inputs, shaped_plant
from ..result import Status, Synthesis, enclosed
from ..riccati.hinf_optimal import hinf
from .ball import below
from .certificate import certify
from .disturbance import Channels, Fit, Shaping, Spectrum, default_fit, design_grid
from .everywhere import Everywhere
from .robust_gain import RobustGain, robust_gain

Array = npt.NDArray[Any]


def worst_case_hinf(
    problem: ObserverProblem,
    *,
    order: int | None = None,
    max_order: int = 4,
    tolerance_db: float = 1.0,
    refinements: int = 1,
    tolerance: float = 1e-3,
    fit: Fit | None = None,
    bounded: bool = True,
) -> Synthesis:
    """Return an observer filter with a certified H-infinity norm for every member of the uncertain set.

    Parameters
    ----------
    problem : ObserverProblem
    order : int, optional
        Order of each shaping filter; default the smallest within `tolerance_db`, up to `max_order`.
    max_order : int
    tolerance_db : float
        Accuracy of the shaping filters. It costs optimality, never validity: the certificate uses the set itself.
    refinements : int
        Rounds after the first design, with multipliers that fit the observer found.
    tolerance : float
        Relative width of the search over the level.
    fit : callable, optional
        As in `worst_case_h2`.
    bounded : bool
        Look for a lower bound as well.

    Returns
    -------
    Synthesis
        ``worst_case_hinf`` from (w1, n) to ``W_p e``, exact for the set but for the margin of its proof, ``lower_bound`` for all observers of either
        injection, and their gap; ``hinf_norm`` is that of the noise alone, ``worst_case_h2`` what the same observer guarantees in the other norm.

    Raises
    ------
    SynthesisError
        When the set is not well posed, the pair undetectable, a model unstable, or no design survives verification.

    Examples
    --------
    >>> from kros.core import StateSpace, gain
    >>> from kros.synthesis import ObserverProblem, worst_case_hinf
    >>> lag = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01)
    >>> problem = ObserverProblem(lag, [[1.0]], gain([[0.1]], 0.01), gain([[1.0]], 0.01), [1.0], [1.0], [0.1])
    >>> found = worst_case_hinf(problem, max_order=1)
    >>> found.lower_bound <= found.worst_case_hinf, found.spectral_radius < 1
    (True, True)
    """
    problem.require_sound()
    fit = fit or default_fit()
    options = {"order": order, "max_order": max_order, "tolerance_db": tolerance_db}
    channels = Channels(problem, design_grid(problem))
    nothing = gain(np.zeros((problem.correction_size, len(problem.C))), problem.nominal.dt)
    loop, best = problem.error_system(nothing), (robust_gain(problem, nothing), nothing)
    if best[0].value == 0:
        return _result(problem, *best, 0.0, 0.0)
    reasons, elapsed = [], 0.0
    for _ in range(refinements + 1):
        spectrum = dominating(channels, loop)
        shaping = channels.shaping(spectrum, fit, "above", options)
        start = time.perf_counter()
        try:
            found = hinf(shaped_plant(problem, *shaping.at_input_and_state(problem)), tolerance=tolerance, injection=problem.injection)
            controller = problem.to_physical(found.controller)
            value = robust_gain(problem, controller)
        except SynthesisError as error:
            reasons.append(str(error))
            break
        finally:
            elapsed += time.perf_counter() - start
        if value.value < best[0].value:
            best = value, controller
        loop = problem.error_system(controller)
    if reasons and best[1] is nothing:
        raise SynthesisError(f"Worst-case H-infinity synthesis: no design survived verification ({'; '.join(reasons)}).")
    lower = _lower_bound(problem, fit, options, tolerance) if bounded else None
    return _result(problem, *best, lower, elapsed / (refinements + 1), bounded)


def _result(
    problem: ObserverProblem, value: RobustGain, controller: StateSpace, lower: float | None, elapsed: float, bounded: bool = True
) -> Synthesis:
    loop = problem.error_system(controller)
    lower, _, notes = enclosed(value.attained, lower) if bounded else (None, None, ())
    n_d = problem.nominal.n_inputs + problem.nominal.n_states
    in_h2, error = certify(problem, controller)
    return Synthesis(
        method="worst_case_hinf",
        controller=controller,
        status=Status.CERTIFIED,
        injection=problem.injection,
        hinf_norm=hinf_norm(StateSpace(loop.A, loop.B[:, n_d:], loop.C, loop.D[:, n_d:], loop.dt)),
        worst_case_hinf=value.value,
        worst_case_h2=in_h2,
        quadrature_error=error,
        lower_bound=lower,
        gap_percent=100 * (value.value / lower - 1) if lower else None,
        spectral_radius=float(loop.spectral_radius()),
        solve_s=elapsed,
        solver="riccati",
        notes=(
            f"The gain is attained at {value.freq_hz:.4g} Hz. The spectral radius is that of the nominal loop; it says nothing about robustness.",
            *notes,
        ),
    )


def dominating(channels: Channels, loop: StateSpace) -> Spectrum:
    """Spectra that bound the disturbance, with the multipliers that suit an observer: its error per unit of every disturbance decides.

    Parameters
    ----------
    channels : Channels
    loop : StateSpace
        Closed error system of that observer.
    """
    problem, ball = channels.problem, channels.ball
    m, n = problem.nominal.n_inputs, problem.nominal.n_states
    response = loop.frequency_response(channels.freqs_hz)
    T = response[..., problem.uncertainty_input] @ channels.left
    Q = [ball.right]
    sizes = [_norm(T @ ball.left) * _norm(ball.right)]
    if problem.remainder_left is not None and problem.remainder_right is not None:
        left = problem.remainder_left.frequency_response(channels.freqs_hz)
        Q.append((problem.remainder_right @ problem.input_weight).frequency_response(channels.freqs_hz))
        sizes.append(_norm(response[..., m : m + n] @ left) * _norm(Q[1]))
    centre = _norm(T @ ball.center)
    share = [np.clip(size / np.maximum(sum(sizes) + centre, 1e-300), 1e-3, 1.0) for size in sizes]
    inner = np.broadcast_to(np.eye(m, dtype=complex), (len(T), m, m))
    for t, matrix in zip(share, Q, strict=True):
        inner = inner - (t / np.maximum(_norm(matrix), 1e-300) ** 2)[:, None, None] * (adjoint(matrix) @ matrix)
    psi = (_norm(Q[0]) ** 2 / share[0])[:, None, None] * (ball.left @ adjoint(ball.left))
    if problem.N is not None:
        psi = psi + ball.center @ np.linalg.pinv(inner, rcond=1e-9, hermitian=True) @ adjoint(ball.center)
    phi = channels.shaped(np.real(np.einsum("fii->fi", psi)))
    if len(Q) == 1:
        return Spectrum(phi, None)
    return Spectrum(phi, np.sum(np.abs(left) ** 2, axis=-1) * (_norm(Q[1]) ** 2 / share[1])[:, None])


def _lower_bound(problem: ObserverProblem, fit: Fit, options: dict[str, Any], tolerance: float) -> float | None:
    """Fit from below, lowered until it is below at every frequency."""
    channels = Channels(problem, design_grid(problem), apart=True)
    shaping = channels.shaping(Spectrum(below(channels.ball.symmetric_part()), None), fit, "below", options)
    return lower_bound(problem, Everywhere(channels).lowered_to_symmetric_part(shaping), tolerance)


def lower_bound(problem: ObserverProblem, shaping: Shaping, tolerance: float) -> float | None:
    """Return a level that no observer of either injection reaches, for filters that lie below the spectrum; None where none is shown.

    Estimates of ``W_p x`` one step ahead, free of any structure, are what is searched: the disturbance is delayed by one sample, which changes no
    norm, so that the output to be estimated is that of the next sample.
    """
    d, r = shaping.at_input_and_state(problem)
    q, n, dt = len(problem.C), problem.nominal.n_states, problem.nominal.dt
    error = problem.error_plant()
    shaped = shape_inputs(error, block_diagonal([d, r, gain(np.eye(q + n), dt)]))
    k = d.n_inputs + r.n_inputs
    moved = np.r_[0:k, k + q : k + q + n]
    moved = moved[(shaped.B1[:, moved] != 0).any(axis=0) | (shaped.D11[:, moved] != 0).any(axis=0)]
    noise = np.arange(k, k + q)
    size, held = len(shaped.A), len(moved)
    A = np.block([[shaped.A, shaped.B1[:, moved]], [np.zeros((held, size + held))]])
    B = np.vstack([np.zeros((size, held)), np.eye(held)])
    C = np.hstack([shaped.C1, shaped.D11[:, moved]])
    p = len(C)
    plant = GeneralizedPlant(
        A,
        np.hstack([B, np.zeros((size + held, q))]),
        np.zeros((size + held, p)),
        C @ A,
        np.hstack([shaped.C2, shaped.D21[:, moved]]),
        np.hstack([C @ B, np.zeros((p, q))]),
        -np.eye(p),
        np.hstack([np.zeros((q, held)), shaped.D21[:, noise]]),
        np.zeros((q, p)),
        dt,
    )
    try:
        return hinf(plant, tolerance=tolerance).lower_bound
    except SynthesisError:
        return None


def _norm(matrix: Array) -> Array:
    return np.asarray(np.linalg.norm(matrix, 2, axis=(-2, -1)))
