r"""Certified worst-case H2 cost of an observer as a smooth function of the filter's matrices.

The certificate integrates ``(b_Delta + b_r)^2 + ||T_n||_F^2`` over the circle. With ``T = [T_d T_r T_n]`` the closed error system and
``P = T_d W_L R_l``, ``Q = R_r M``, its simple bound ``b_Delta = ||T_d W_L X_c M||_F + h(P)``, ``h(P)^2 = sum_i s_i(P)^2 s_i(Q)^2``, is differentiable:

    d||T_d C||_F = Re <T_d C C^H, dT_d> / ||T_d C||_F,        d h = Re <U diag(s_i q_i^2) V^H, dP> / h,   P = U diag(s) V^H,

and so is ``b_r = h`` of the remainder. Where the dual bound is sharper, its ratio to the simple one is kept from where the descent began. What the
derivative with respect to T becomes for Theta follows from ``dT = L dTheta R`` (`affine_loop`). The cost serves as a guide; what counts is the certificate.

Symbols
-------
T : (f, p, w) closed error system;  L : (f, p, n_u + n_c);  R : (f, n_y + n_c, w);  Gamma : derivative with respect to T, (f, p, w)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.linalg import adjoint, qr_triangle
from ...core.lti import StateSpace
from ..problem.observer_problem import ObserverProblem
from ..worst_case.disturbance import uncertain_ball
from .affine_loop import AffineLoop, typical

Array = npt.NDArray[Any]

_TINY = 1e-150


@dataclass(frozen=True)
class Guard:
    """What the nodes resolve: poles neither slower than the first node nor less damped than the start or the spacing of the nodes allow."""

    slowest: float
    damping: float

    @classmethod
    def of(cls, closed: StateSpace, angle: Array) -> Guard:
        """Read the limits off the loop at the start."""
        return cls(float(angle.min()), min(0.03, 0.5 * float(_damping(closed).min(initial=1.0))))

    def allows(self, closed: StateSpace) -> bool:
        """Tell whether the loop is stable and its response is smooth between the nodes."""
        poles = np.maximum(np.abs(closed.poles() - 1), 1e-300)
        return bool(closed.is_stable() and poles.min(initial=1.0) > self.slowest and _damping(closed).min(initial=1.0) >= self.damping)


def _damping(closed: StateSpace) -> Array:
    poles = closed.poles().astype(complex)
    logarithm = np.log(poles[np.abs(poles) > 1e-3])
    return -logarithm.real / np.maximum(np.abs(logarithm), 1e-300)


@dataclass(frozen=True, eq=False)
class CertifiedCost:
    """The cost on fixed nodes.

    Parameters
    ----------
    loop : AffineLoop
        Of `problem.error_plant()`.
    weight : ndarray, shape (f,)
        Of the nodes; they sum to one.
    freqs_hz : ndarray, shape (f,)
    uncertainty_input, state : slice
        Inputs of the loop at which the perturbation and the remainder act.
    W_L, center, left : ndarray
        Responses of the left weight and of the ball (`kros.synthesis.worst_case.ball`).
    q : ndarray, shape (f, any)
        Singular values of ``R_r M``.
    ratio : ndarray, shape (f,)
        Certified over simple bound.
    remainder : tuple of ndarray or None
        Left weight of the remainder and the singular values of its right factor.
    guard : Guard
    """

    loop: AffineLoop
    weight: Array
    freqs_hz: Array
    uncertainty_input: slice
    state: slice
    W_L: Array
    center: Array
    left: Array
    q: Array
    ratio: Array
    remainder: tuple[Array, Array] | None
    guard: Guard

    @classmethod
    def around(cls, problem: ObserverProblem, controller: StateSpace) -> CertifiedCost:
        """Prepare the cost near a controller in scaled coordinates."""
        plant = problem.error_plant()
        closed, dt = plant.close(controller), plant.dt
        remainder = None
        systems = [closed, problem.W_L, problem.M, problem.N, problem.remainder_left, problem.remainder_right]
        poles = np.concatenate([s.poles() for s in systems if s is not None]).astype(complex)
        angle, weight = nodes(np.log(poles[(poles.imag >= 0) & (np.abs(poles) > 1e-3)]))
        freqs = angle / (2 * np.pi * dt)
        ball = uncertain_ball(problem, freqs)
        W_L = problem.W_L.frequency_response(freqs)
        m, n = problem.nominal.n_inputs, problem.nominal.n_states
        if problem.remainder_left is not None and problem.remainder_right is not None:
            right = (problem.remainder_right @ problem.input_weight).frequency_response(freqs)
            remainder = problem.remainder_left.frequency_response(freqs), np.linalg.svd(right, compute_uv=False)
        q = np.linalg.svd(ball.right, compute_uv=False)
        state = slice(m, m + n)
        loop, one, guard = AffineLoop(plant, controller.n_states), np.ones(len(freqs)), Guard.of(closed, angle)
        cost = cls(loop, weight, freqs, problem.uncertainty_input, state, W_L, ball.center, ball.left, q, one, remainder, guard)
        T = closed.frequency_response(freqs)[..., problem.uncertainty_input] @ W_L
        simple, _ = cost._simple(T)
        ratio = ball.bound(T) / np.maximum(simple, _TINY)
        return replace(cost, ratio=ratio)

    def __call__(self, theta: Array) -> tuple[float, Array]:
        """Return the squared cost and its gradient; infinite for an unstable loop."""
        closed = self.loop.close(theta)
        if not self.guard.allows(closed):
            return float("inf"), np.zeros_like(theta)
        left, T, right = self.loop.responses(theta, self.freqs_hz)
        simple, towards = self._simple(T[..., self.uncertainty_input] @ self.W_L)
        amplitude, Gamma = self.ratio * simple, 2 * T
        Gamma[..., self.uncertainty_input], Gamma[..., self.state] = 0.0, 0.0
        remainder = None
        if self.remainder is not None:
            W_r, q = self.remainder
            size, remainder = _spread(T[..., self.state] @ W_r, q)
            amplitude = amplitude + size
            Gamma[..., self.state] += 2 * amplitude[:, None, None] * (remainder @ adjoint(W_r))
        Gamma[..., self.uncertainty_input] += 2 * (amplitude * self.ratio)[:, None, None] * (towards @ adjoint(self.W_L))
        noise = T[..., self.state.stop :]
        value = float(self.weight @ (amplitude**2 + np.sum(np.abs(noise) ** 2, axis=(-2, -1))))
        weighted = self.weight[:, None, None] * Gamma
        return value, np.real(np.sum(adjoint(left) @ weighted @ adjoint(right), axis=0))

    def roots(self, theta: Array) -> tuple[Array, Array]:
        """Factors R and S of the Gramians of the filter's states in the loop, driven by the set's average and seen in the error.

        They come from quadrature, since the spectrum is not rational: ``R R' = sum_k w_k x_k x_k^H`` over the responses x_k to each component.
        """
        _, _, n_u, _, n_y = self.loop.plant.sizes
        left, driven = self._signals(theta)
        return self._root(driven[:, n_y:]), self._root(adjoint(left[:, :, n_u:]))

    def typical(self, theta: Array) -> Array:
        """Size of every entry of Theta that changes the cost by about as much as any other; see `AffineLoop.typical`."""
        left, driven = self._signals(theta)
        seen = np.einsum("f,fij->i", self.weight, np.abs(driven) ** 2)
        return typical(np.einsum("f,fij->j", self.weight, np.abs(left) ** 2), seen)

    def _signals(self, theta: Array) -> tuple[Array, Array]:
        """Responses of the error to what Theta drives, and of what Theta sees to the set's average disturbance and the noise."""
        left, _, right = self.loop.responses(theta, self.freqs_hz)
        energy = np.linalg.norm(self.q, axis=-1) / np.sqrt(self.left.shape[-1])
        at_input = right[:, :, self.uncertainty_input] @ self.W_L
        driven = [at_input @ self.center, at_input @ self.left * energy[:, None, None], right[:, :, self.state.stop :]]
        if self.remainder is not None:
            W_r, q = self.remainder
            driven.append(right[:, :, self.state] @ W_r * (np.linalg.norm(q, axis=-1) / np.sqrt(W_r.shape[-1]))[:, None, None])
        return left, np.concatenate(driven, axis=-1)

    def _root(self, responses: Array) -> Array:
        columns = (np.sqrt(self.weight)[:, None, None] * responses).transpose(1, 0, 2).reshape(responses.shape[1], -1)
        return qr_triangle(np.hstack([columns.real, columns.imag]).T).T

    def _simple(self, T: Array) -> tuple[Array, Array]:
        """Simple bound per frequency and its derivative with respect to ``T_d W_L``."""
        through = T @ self.center
        size = np.linalg.norm(through, axis=(-2, -1))
        ball, towards = _spread(T @ self.left, self.q)
        derivative = through @ adjoint(self.center) / np.maximum(size, _TINY)[:, None, None] + towards @ adjoint(self.left)
        return size + ball, derivative


def nodes(poles: Array) -> tuple[Array, Array]:
    """Angles in (0, pi] and weights, which sum to one, of a rule that is denser around poles given as ``log z``.

    Three Gauss points a panel, ten panels a decade, and panels of growing width around every resonance.
    """
    angle, width = np.abs(poles.imag), np.maximum(np.abs(poles.real), 1e-9)
    low = float(np.clip(0.05 * np.hypot(angle, width).min(initial=1.0), 1e-9, 1e-2))
    sharp = angle > width
    widths = np.array([-16, -4, -1, -0.25, 0.25, 1, 4, 16])
    around = (angle[sharp, None] + width[sharp, None] * widths).ravel()
    decades = np.log10(np.pi / low)
    edges = np.unique(np.concatenate([np.geomspace(low, np.pi, 2 + int(10 * decades)), around[(around > low) & (around < np.pi)]]))
    edges = np.concatenate([[0.0], edges[np.concatenate([[True], np.diff(np.log(edges)) > 1e-6])]])
    edges[-1] = np.pi
    points, gauss = np.polynomial.legendre.leggauss(3)
    half = np.diff(edges) / 2
    return (edges[:-1, None] + half[:, None] * (1 + points)).ravel(), (half[:, None] * gauss).ravel() / np.pi


def _spread(P: Array, q: Array) -> tuple[Array, Array]:
    """Largest ``||P Theta Q||_F`` over contractions, and its derivative with respect to P."""
    U, s, Vh = np.linalg.svd(P, full_matrices=False)
    k = min(s.shape[-1], q.shape[-1])
    s, q = s[..., :k], q[..., :k]
    size = np.sqrt(np.sum((s * q) ** 2, axis=-1))
    return size, (U[..., :k] * (s * q**2 / np.maximum(size, _TINY)[:, None])[:, None, :]) @ Vh[..., :k, :]
