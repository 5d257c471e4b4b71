r"""Local improvement of a mixed controller of fixed order: ``min ||T11||_2`` subject to ``||T22||_inf < gamma``.

Sequential quadratic programming on the controller's matrices ``Theta = [[D^c, C^c], [B^c, A^c]]``, a static gain for
the plant that carries the controller's states along (D22 = 0):

    A_cl = A_0 + B_u Theta C_y,   B_cl = B_0 + B_u Theta D_y,
    C_cl = C_0 + D_u Theta C_y,   D_cl = D_0 + D_u Theta D_y,

so that ``dT = (C_cl Phi B_u + D_u) dTheta (C_y Phi B_cl + D_y)``, ``Phi = (zI - A_cl)^-1``. With the Gramians P and Q
of T11 the derivative of ``||T11||_2^2 = tr(C_cl P C_cl' + D_cl D_cl')`` is

    2 [B_u' (Q A_cl P C_y' + Q B_cl D_y') + D_u' (C_cl P C_y' + D_cl D_y')].

The constraint is set at frequencies, where ``sigma_max(T22)`` has the gradient ``Re(u* dT v)`` with its singular
vectors. The norm between the frequencies is then computed by level sets; where it exceeds gamma the peaks join the
frequencies and the level is lowered.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...core.norms import first_frequencies, gramian, h2_norm, hinf_norm
from ..generalized_plant import GeneralizedPlant

Array = npt.NDArray[Any]

_ROUNDS, _ITERATIONS = 8, 60
_BACK_OFF = 1e-4  # of the level, relative, for peaks between the frequencies
_UNSTABLE = 1e3  # logarithm of the squared norm of a loop that is not stable


@dataclass(frozen=True, eq=False)
class _Loop:
    """Closed loop of a plant with a controller of `order` states, as a function of x = Theta / units."""

    plant: GeneralizedPlant
    order: int
    gamma: float
    end: float
    units: Array

    @property
    def sides(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """B_u and D_u, what Theta drives, and C_y and D_y, what it sees."""
        p, k = self.plant, self.order
        n, n_w, n_u, n_z, n_y = p.sizes
        eye = np.eye(k)
        B_u = np.block([[p.B2, np.zeros((n, k))], [np.zeros((k, n_u)), eye]])
        C_y = np.block([[p.C2, np.zeros((n_y, k))], [np.zeros((k, n)), eye]])
        return (B_u, np.hstack([p.D12, np.zeros((n_z, k))])), (C_y, np.vstack([p.D21, np.zeros((k, n_w))]))

    def controller(self, x: Array) -> StateSpace:
        """Return the controller."""
        theta, (_, _, n_u, _, n_y) = x.reshape(self.units.shape) * self.units, self.plant.sizes
        return StateSpace(theta[n_u:, n_y:], theta[n_u:, :n_y], theta[:n_u, n_y:], theta[:n_u, :n_y], self.plant.dt)

    def cost(self, x: Array) -> tuple[float, Array]:
        """Logarithm of the squared H2 norm of T11 and its gradient."""
        if time.perf_counter() > self.end:
            raise TimeoutError
        loop, ((B_u, D_u), (C_y, D_y)), p = self.plant.close(self.controller(x)), self.sides, self.plant
        if not loop.is_stable():
            return _UNSTABLE, np.zeros_like(x)
        rows, columns = p.rows(1), p.columns(1)
        B, C, D, D_u, D_y = loop.B[:, columns], loop.C[rows], loop.D[rows, columns], D_u[rows], D_y[:, columns]
        P, Q = gramian(loop.A, B, loop.dt), gramian(loop.A.T, C.T, loop.dt)
        gradient = B_u.T @ Q @ (loop.A @ P @ C_y.T + B @ D_y.T) + D_u.T @ (C @ P @ C_y.T + D @ D_y.T)
        value = max(float(np.trace(C @ P @ C.T) + np.sum(D**2)), 1e-300)
        return float(np.log(value)), 2 * (gradient * self.units).ravel() / value

    def gains(self, x: Array, freqs_hz: Array) -> tuple[Array, Array]:
        """Logarithm of ``sigma_max(T22) / gamma`` at the frequencies, and its derivatives, shape (f, x)."""
        loop, ((B_u, D_u), (C_y, D_y)), p = self.plant.close(self.controller(x)), self.sides, self.plant
        rows, columns = p.rows(2), p.columns(2)
        z = np.exp(2j * np.pi * freqs_hz * loop.dt)
        resolvent = np.linalg.inv(z[:, None, None] * np.eye(loop.n_states) - loop.A)
        B, C = loop.B[:, columns], loop.C[rows]
        U, s, Vh = np.linalg.svd(C @ resolvent @ B + loop.D[rows, columns], full_matrices=False)
        left = np.einsum("fi,fij->fj", U[:, :, 0].conj(), C @ resolvent @ B_u + D_u[rows])
        right = np.einsum("fij,fj->fi", C_y @ resolvent @ B + D_y[:, columns], Vh[:, 0].conj())
        slope = np.real(left[:, :, None] * right[:, None, :]) * self.units
        size = np.maximum(s[:, 0], 1e-300)
        return np.log(size / self.gamma), slope.reshape(len(z), -1) / size[:, None]


def improved(plant: GeneralizedPlant, controller: StateSpace, gamma: float, time_limit_s: float) -> StateSpace:
    """Return a controller of the same order that is at least as good, for one with ``||T22||_inf < gamma``."""
    K, end = controller, time.perf_counter() + time_limit_s
    theta = np.block([[K.D, K.C], [K.B, K.A]])
    loop = _Loop(plant, K.n_states, gamma, end, _units(plant, K))
    x, best, least = (theta / loop.units).ravel(), K, h2_norm(plant.performance.close(K))
    freqs_hz, level = _frequencies(plant.close(K)), 1 - _BACK_OFF
    for _ in range(_ROUNDS):
        try:
            x_new = _programme(loop, x, freqs_hz, level)
        except (TimeoutError, np.linalg.LinAlgError, ValueError):
            break
        candidate = loop.controller(x_new)
        norm, peak = h2_norm(plant.performance.close(candidate)), hinf_norm(plant.uncertainty.close(candidate))
        if peak < gamma:
            gained = 1 - norm / least
            if gained > 0:
                best, least, x = candidate, norm, x_new
            if gained < 1e-4:
                break
            continue
        if not np.isfinite(peak):  # nor is there a peak that could join the frequencies
            level *= 1 - 100 * _BACK_OFF
            continue
        dense = _frequencies(plant.close(candidate), 6)
        excess, _ = loop.gains(x_new, dense)
        peaks = (excess >= np.maximum(np.roll(excess, 1), np.roll(excess, -1))) & (excess > np.log(level) - 0.05)
        freqs_hz = np.union1d(freqs_hz, dense[peaks])
        level = min(level, level * gamma / peak * (1 - _BACK_OFF)) if peak < 1.05 * gamma else level
        x = x_new if peak < 1.5 * gamma else x
    return best


def _units(plant: GeneralizedPlant, controller: StateSpace) -> Array:
    """Size of every entry of Theta that changes the norm by about as much as any other, shape of Theta."""
    empty = np.zeros((0, 0))
    closed = plant.close(controller)
    (B_u, D_u), (C_y, D_y) = _Loop(plant, controller.n_states, 1.0, 0.0, empty).sides
    P, Q = gramian(closed.A, closed.B, closed.dt), gramian(closed.A.T, closed.C.T, closed.dt)
    seen = np.einsum("ij,jk,ik->i", C_y, P, C_y) + np.sum(D_y**2, axis=1)
    driven = np.einsum("ji,jk,ki->i", B_u, Q, B_u) + np.sum(D_u**2, axis=0)
    product = np.outer(driven, seen)
    return np.asarray(1 / np.sqrt(np.maximum(product, 1e-24 * product.max(initial=0.0) + 1e-300)))


def _programme(loop: _Loop, x: Array, freqs_hz: Array, level: float) -> Array:
    """Run sequential quadratic programming with the constraint at some frequencies."""
    from scipy.optimize import minimize

    remembered: dict[bytes, tuple[Array, Array]] = {}

    def gains(point: Array) -> tuple[Array, Array]:
        key = point.tobytes()
        if key not in remembered:
            remembered.clear()
            remembered[key] = loop.gains(point, freqs_hz)
        return remembered[key]

    room: dict[str, Any] = {"type": "ineq", "fun": lambda v: np.log(level) - gains(v)[0], "jac": lambda v: -gains(v)[1]}
    rooms = [room] if loop.plant.uncertainty.D11.size else []
    options = {"maxiter": _ITERATIONS, "ftol": 1e-7}
    return np.asarray(minimize(loop.cost, x, jac=True, method="SLSQP", constraints=rooms, options=options).x)


def _frequencies(closed: StateSpace, factor: int = 1) -> Array:
    """Frequencies in Hz of a discrete loop: of the poles, around them, and evenly spaced."""
    poles = closed.poles().astype(complex)
    top = 0.5 / closed.dt
    sizes = first_frequencies(np.log(poles[np.abs(poles) > 1e-9]) / closed.dt) / (2 * np.pi)
    grid = np.geomspace(max(sizes[1], 1e-6 * top), top, 40 * factor)
    return np.unique(np.concatenate([grid, np.linspace(0, top, 30 * factor), sizes[sizes < top]]))
