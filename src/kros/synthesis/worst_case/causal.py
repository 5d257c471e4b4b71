r"""The worst causal perturbation that is found: a lower estimate beside the certified bound, which allows noncausal ones.

Candidates are ``Delta(z) = a(z) R`` with R a real contraction and ``a = 1`` or an all-pass filter of first order, whose lag aligns the loop N at
one frequency after the other. For given a, R climbs by the polar factor of the gradient of

.. math:: J(R) = \frac{1}{2\pi}\int \|T X M + T_r R_r M_r\|_F^2\,d\theta, \qquad X = \Delta(I - N\Delta)^{-1},\quad
          dX = (I - \Delta N)^{-1}\,d\Delta\,(I - N\Delta)^{-1}

(without a loop J is convex, so that no step decreases it). What is returned is the H2 norm of the interconnection with the best candidate, by
a Lyapunov equation, not the integral.

Symbols
-------
R : (b, a);  R_r : remainder's perturbation;  T, M, N : as in `ball`, over f frequencies, the candidates first
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.linalg import adjoint
from ...core.lti import StateSpace, block_diagonal, gain
from ...core.norms import h2_norm
from ..generalized_plant import split
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import generalized_plant
from .ball import polar
from .disturbance import design_grid

Array = npt.NDArray[Any]

_POINTS, _LAGS, _STEPS, _CHECKED = 100, 6, 8, 3


def causal_h2(problem: ObserverProblem, controller: StateSpace) -> float:
    """Return the largest H2 norm of ``W_p e``, noise included, that is found for a causal stable contraction.

    Parameters
    ----------
    problem : ObserverProblem
    controller : StateSpace
        In physical units.
    """
    dt = problem.nominal.dt
    theta = np.geomspace(2 * np.pi * dt * design_grid(problem)[0], np.pi, _POINTS)
    parts = _Parts.of(problem, controller, theta / (2 * np.pi * dt), np.gradient(theta))
    corners = np.geomspace(theta[0] * 10, 1.0, _LAGS) if problem.N is not None else np.zeros(0)
    filters = [gain([[1.0]], dt)] + [_all_pass(np.exp(-corner), dt) for corner in corners]
    values, found, rests = [], [], []
    for start in parts.starts():
        value, R, rest = parts.ascend(filters, start)
        values.append(value)
        found.append(R)
        rests.append(rest)
    order = np.argsort(-np.concatenate(values))[:_CHECKED]
    R, rest = np.concatenate(found), np.concatenate(rests)
    closed = generalized_plant(problem).close(problem.to_scaled(controller))
    return max(h2_norm(perturbed(problem, closed, _times(filters[k % len(filters)], R[k]), gain(rest[k], dt))) for k in order)


def perturbed(problem: ObserverProblem, closed: StateSpace, delta: StateSpace, rest: StateSpace | None = None) -> StateSpace:
    """Return the observer's loop from (w1, n, v) to z1, scaled, with a causal perturbation.

    Parameters
    ----------
    problem : ObserverProblem
    closed : StateSpace
        Its generalized plant with the observer's filter.
    delta : StateSpace
        Perturbation, from z2 to w2.
    rest : StateSpace, optional
        Perturbation of the remainder, from z3 to w3, where the problem has one.
    """
    plant = generalized_plant(problem)
    acts = [plant.part("w", name) for name in ("w2", "w3") if name in plant.w_parts]
    sees = [plant.part("z", name) for name in ("z2", "z3") if name in plant.z_parts]
    u, y = np.concatenate(acts), np.concatenate(sees)
    w = np.setdiff1d(np.arange(closed.n_inputs), u)
    z = plant.part("z", "z1")
    ins, outs = np.concatenate([w, u]), np.concatenate([z, y])
    ordered = StateSpace(closed.A, closed.B[:, ins], closed.C[outs], closed.D[np.ix_(outs, ins)], closed.dt)
    whole = split(ordered, len(w), len(z))
    return whole.close(block_diagonal([delta, rest]) if len(acts) == 2 and rest is not None else delta)


@dataclass(frozen=True, eq=False)
class _Parts:
    """Responses on a grid; T and T_r contain the square root of the quadrature's weights."""

    T: Array
    M: Array
    N: Array | None
    T_r: Array
    M_r: Array
    freqs_hz: Array

    @classmethod
    def of(cls, problem: ObserverProblem, controller: StateSpace, freqs_hz: Array, weights: Array) -> _Parts:
        m, n = problem.nominal.n_inputs, problem.nominal.n_states
        response = problem.error_system(controller).frequency_response(freqs_hz) * np.sqrt(weights)[:, None, None]
        T_r, M_r = np.zeros((len(freqs_hz), response.shape[1], 1)), np.zeros((len(freqs_hz), 1, m))
        if problem.remainder_left is not None and problem.remainder_right is not None:
            T_r = response[..., m : m + n] @ problem.remainder_left.frequency_response(freqs_hz)
            M_r = (problem.remainder_right @ problem.input_weight).frequency_response(freqs_hz)
        N = None if problem.N is None else problem.N.frequency_response(freqs_hz)
        T = response[..., problem.uncertainty_input] @ problem.W_L.frequency_response(freqs_hz)
        return cls(T, problem.M.frequency_response(freqs_hz), N, T_r, M_r, freqs_hz)

    def starts(self) -> list[Array]:
        """The identity, its negative, and what aligns the largest directions of T and M over all frequencies."""
        _, left = np.linalg.eigh(np.real(adjoint(self.T) @ self.T).sum(axis=0))
        _, right = np.linalg.eigh(np.real(self.M @ adjoint(self.M)).sum(axis=0))
        k = min(len(left), len(right))
        eye = np.eye(len(left), len(right))
        aligned = left[:, ::-1][:, :k] @ right[:, ::-1][:, :k].T
        return [eye, aligned] if self.N is None else [eye, -eye, aligned]

    def ascend(self, filters: list[StateSpace], start: Array) -> tuple[Array, Array, Array]:
        """Return the best value, R and R_r for every filter."""
        lag = np.concatenate([a.frequency_response(self.freqs_hz)[..., 0] for a in filters], axis=-1).T[..., None, None]
        R = np.broadcast_to(start, (len(filters), *start.shape))
        rest = np.zeros((len(filters), self.T_r.shape[-1], self.M_r.shape[-2]))
        best, best_R, best_rest = np.full(len(filters), -np.inf), R, rest
        for _ in range(_STEPS):
            delta = lag * R[:, None]
            if self.N is None:
                left, right = self.T, self.M
                effect = delta @ self.M
            else:
                loop = np.linalg.inv(np.eye(self.N.shape[-2]) - self.N @ delta)
                right = loop @ self.M
                effect = delta @ right
                left = self.T + self.T @ delta @ loop @ self.N  # T (I - Delta N)^-1
            error = self.T @ effect + self.T_r @ rest[:, None] @ self.M_r
            value = np.sum(np.abs(error) ** 2, axis=(-3, -2, -1))
            better = value > best
            best = np.where(better, value, best)
            best_R, best_rest = np.where(better[:, None, None], R, best_R), np.where(better[:, None, None], rest, best_rest)
            R = polar(np.real(np.conj(lag) * (adjoint(left) @ error @ adjoint(right))).sum(axis=1))
            rest = polar(np.real(adjoint(self.T_r) @ error @ adjoint(self.M_r)).sum(axis=1))
        return best, best_R, best_rest


def _all_pass(pole: float, dt: float) -> StateSpace:
    """``(1 - p z) / (z - p)``."""
    p, root = np.array([[pole]]), np.array([[np.sqrt(1 - pole**2)]])
    return StateSpace(p, root, root, -p, dt)


def _times(a: StateSpace, R: Array) -> StateSpace:
    """``a(z) R`` for one filter a and a matrix."""
    R = R * (1 - 1e-12)
    return block_diagonal([a] * len(R)) @ gain(R, a.dt)
