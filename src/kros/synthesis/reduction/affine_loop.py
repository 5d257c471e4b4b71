r"""The closed loop as an affine function of the controller's matrices, and the gradient of its H2 norm.

With ``D22 = 0`` and ``Theta = [[D^c, C^c], [B^c, A^c]]``, a static gain for the plant that carries the controller's states along,

    A_cl = A_0 + B_u Theta C_y,   B_cl = B_0 + B_u Theta D_y,   C_cl = C_0 + D_u Theta C_y,   D_cl = D_0 + D_u Theta D_y,

so that ``dT = (C_cl Phi B_u + D_u) dTheta (C_y Phi B_cl + D_y)``, ``Phi = (zI - A_cl)^-1``. With the Gramians ``P = A_cl P A_cl' + B_cl B_cl'``
and ``Q = A_cl' Q A_cl + C_cl' C_cl`` the derivative of ``||T||_2^2 = tr(C_cl P C_cl' + D_cl D_cl')`` is

    2 [B_u' (Q A_cl P C_y' + Q B_cl D_y') + D_u' (C_cl P C_y' + D_cl D_y')].

A feedthrough D22 is taken out of the controller first and put back in the end.

Symbols
-------
Theta : (n_u + n_c, n_y + n_c);  P, Q : Gramians of the closed loop, (n + n_c, n + n_c)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...core.norms import gramian
from ..generalized_plant import GeneralizedPlant
from ..riccati.equations import absorb_feedthrough

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class AffineLoop:
    """Closed loop of a plant with a controller of `order` states, as a function of Theta."""

    plant: GeneralizedPlant
    order: int

    def theta(self, controller: StateSpace) -> Array:
        """Matrices of a controller as one, shape (n_u + n_c, n_y + n_c)."""
        K = absorb_feedthrough(controller, -self.plant.D22)
        return np.block([[K.D, K.C], [K.B, K.A]])

    def controller(self, theta: Array) -> StateSpace:
        """Inverse of `theta`."""
        _, _, n_u, _, n_y = self.plant.sizes
        K = StateSpace(theta[n_u:, n_y:], theta[n_u:, :n_y], theta[:n_u, n_y:], theta[:n_u, :n_y], self.plant.dt)
        return absorb_feedthrough(K, self.plant.D22)

    @property
    def into(self) -> tuple[Array, Array]:
        """B_u and D_u: what Theta drives."""
        p, k = self.plant, self.order
        n, _, n_u, n_z, _ = p.sizes
        return (
            np.block([[p.B2, np.zeros((n, k))], [np.zeros((k, n_u)), np.eye(k)]]),
            np.hstack([p.D12, np.zeros((n_z, k))]),
        )

    @property
    def out_of(self) -> tuple[Array, Array]:
        """C_y and D_y: what Theta sees."""
        p, k = self.plant, self.order
        n, n_w, _, _, n_y = p.sizes
        return (
            np.block([[p.C2, np.zeros((n_y, k))], [np.zeros((k, n)), np.eye(k)]]),
            np.vstack([p.D21, np.zeros((k, n_w))]),
        )

    def close(self, theta: Array) -> StateSpace:
        """Return the closed loop from w to z."""
        p, k = self.plant, self.order
        n, n_w, _, n_z, _ = p.sizes
        (B_u, D_u), (C_y, D_y) = self.into, self.out_of
        A = np.zeros((n + k, n + k))
        A[:n, :n] = p.A
        return StateSpace(
            A + B_u @ theta @ C_y,
            np.vstack([p.B1, np.zeros((k, n_w))]) + B_u @ theta @ D_y,
            np.hstack([p.C1, np.zeros((n_z, k))]) + D_u @ theta @ C_y,
            p.D11 + D_u @ theta @ D_y,
            p.dt,
        )

    def h2_squared(self, theta: Array, rows: slice = slice(None), columns: slice = slice(None)) -> tuple[float, Array]:
        """Return the squared H2 norm from some inputs to some outputs, and its gradient; infinite for an unstable loop."""
        loop = self.close(theta)
        if not loop.is_stable():
            return float("inf"), np.zeros_like(theta)
        B, C, D = loop.B[:, columns], loop.C[rows], loop.D[rows, columns]
        (B_u, D_u), (C_y, D_y) = self.into, self.out_of
        D_u, D_y = D_u[rows], D_y[:, columns]
        P, Q = gramian(loop.A, B, loop.dt), gramian(loop.A.T, C.T, loop.dt)
        gradient = B_u.T @ Q @ (loop.A @ P @ C_y.T + B @ D_y.T) + D_u.T @ (C @ P @ C_y.T + D @ D_y.T)
        return float(np.trace(C @ P @ C.T) + np.sum(D**2)), 2 * gradient

    def responses(self, theta: Array, freqs_hz: Array) -> tuple[Array, Array, Array]:
        """Return L, T and R of ``dT = L dTheta R``: shapes (f, n_z, n_u + n_c), (f, n_z, n_w), (f, n_y + n_c, n_w)."""
        loop, (B_u, D_u), (C_y, D_y) = self.close(theta), self.into, self.out_of
        rows, columns = D_u.shape
        D = np.block([[D_u, loop.D], [np.zeros((len(D_y), columns)), D_y]])
        both = StateSpace(loop.A, np.hstack([B_u, loop.B]), np.vstack([loop.C, C_y]), D, loop.dt)
        response = both.frequency_response(freqs_hz)
        return response[:, :rows, :columns], response[:, :rows, columns:], response[:, rows:, columns:]

    def typical(self, theta: Array) -> Array:
        """Size of every entry of Theta that changes the norm by about as much as any other, shape of Theta."""
        loop, (B_u, D_u), (C_y, D_y) = self.close(theta), self.into, self.out_of
        P, Q = gramian(loop.A, loop.B, loop.dt), gramian(loop.A.T, loop.C.T, loop.dt)
        seen = np.einsum("ij,jk,ik->i", C_y, P, C_y) + np.sum(D_y**2, axis=1)
        driven = np.einsum("ji,jk,ki->i", B_u, Q, B_u) + np.sum(D_u**2, axis=0)
        return typical(driven, seen)


def typical(driven: Array, seen: Array) -> Array:
    """Return ``1 / sqrt(driven_i seen_j)``, bounded where nothing is driven or seen."""
    product = np.outer(driven, seen)
    return np.asarray(1 / np.sqrt(np.maximum(product, 1e-24 * product.max(initial=0.0) + 1e-300)))
