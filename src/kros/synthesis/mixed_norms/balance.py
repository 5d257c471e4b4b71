r"""Coordinates for the mixed inequalities, from the H2-optimal controller.

An accurate sensor makes the error of the optimal estimate many decades smaller than the state, so nothing here subtracts one covariance from
another: everything is computed in the coordinates (error, estimate) of the optimal observer, in which the loop is block triangular.

Symbols
-------
x, x_hat : state of the plant and of the reference controller;  e = x - x_hat
L = B^c - B2 D^c : predictor gain;  J = A - L C2 : error dynamics, e+ = J e + ...;  A^c = J + B2 C^c
E, W, F : covariance of e, of x_hat, and their cross covariance;  X = E + F + F' + W : covariance of x
T : coordinates in which X = E^-1 = diag(s)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.linalg import LinAlgError

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.norms import gramian
from ..generalized_plant import GeneralizedPlant
from ..riccati.h2 import h2

Array = npt.NDArray[Any]

_KNOWN = 1e-28  # share of a state's variance below which rounding alone keeps it from being known exactly
_LITTLE = 1e-3  # disturbance of such a state, in its standard deviations


@dataclass(frozen=True, eq=False)
class Balanced:
    """A plant in balanced coordinates, z1 divided by `size`, with the diagonal `spread` of X and Y to expect."""

    plant: GeneralizedPlant
    size: float
    spread: Array
    controls: Array
    measurements: Array

    def inside(self, K: StateSpace) -> StateSpace:
        """Return the controller of the balanced plant for one of the original."""
        c, m = self.controls[:, None], self.measurements
        return StateSpace(K.A, K.B * m, K.C / c, K.D * m / c, K.dt)

    def controller(self, K: StateSpace) -> StateSpace:
        """Return the controller of the original plant."""
        c, m = self.controls[:, None], self.measurements
        return StateSpace(K.A, K.B / m, c * K.C, c * K.D / m, K.dt)


def balance(plant: GeneralizedPlant) -> Balanced:
    """Balance a plant for the mixed inequalities; a `SynthesisError` where it is not regular or has states that no disturbance reaches."""
    plant = replace(plant, D22=np.zeros_like(plant.D22))
    rows = plant.rows(1)
    performance = plant.channel(rows, slice(None))
    K = h2(performance).controller
    E, F, W = covariances(plant, K)
    try:
        root = np.linalg.cholesky(E + F + F.T + W)
        inverse = np.linalg.inv(np.linalg.cholesky(E))
    except LinAlgError as error:
        raise SynthesisError(
            "Mixed synthesis: some states of the plant are not reached by any disturbance; reduce the plant to a minimal one."
        ) from error
    U, s, Vh = np.linalg.svd(inverse @ root)
    T, back = (U / np.sqrt(s)).T @ inverse, root @ Vh.T / np.sqrt(s)
    closed = performance.close(K)
    P = gramian(closed.A, closed.B, closed.dt)
    size = float(np.sqrt(np.trace(closed.C @ P @ closed.C.T) + np.sum(closed.D**2)))
    scale = np.ones(plant.sizes[3])
    scale[rows] = 1 / max(size, 1e-300)
    measurements = np.sqrt(np.diag(plant.C2 @ E @ plant.C2.T + plant.D21 @ plant.D21.T))
    controls = size / np.linalg.norm(plant.D12[rows], axis=0)
    balanced = replace(
        plant,
        A=T @ plant.A @ back,
        B1=T @ plant.B1,
        B2=T @ plant.B2 * controls,
        C1=(plant.C1 * scale[:, None]) @ back,
        C2=plant.C2 @ back / measurements[:, None],
        D11=plant.D11 * scale[:, None],
        D12=plant.D12 * scale[:, None] * controls,
        D21=plant.D21 / measurements[:, None],
    )
    return Balanced(balanced, size, s, controls, measurements)


def reached(plant: GeneralizedPlant) -> GeneralizedPlant:
    """Give every state a little disturbance in w1 where one is known exactly, such as that of a weight on the control; else the plant itself."""
    bare = replace(plant, D22=np.zeros_like(plant.D22))
    E, F, W = covariances(bare, h2(bare.channel(bare.rows(1), slice(None))).controller)
    sizes = np.sqrt(np.diag(E + F + F.T + W))
    if (np.diag(E) > _KNOWN * sizes**2).all():
        return plant
    n, _, _, n_z, n_y = plant.sizes
    w1 = plant.columns(1).stop if plant.n_w1 is not None else plant.sizes[1]
    noise = np.diag(_LITTLE * np.where(sizes > 0, sizes, sizes.max(initial=0.0)))
    return replace(
        plant,
        B1=np.insert(plant.B1, [w1] * n, noise, axis=1),
        D11=np.insert(plant.D11, [w1] * n, np.zeros((n_z, n)), axis=1),
        D21=np.insert(plant.D21, [w1] * n, np.zeros((n_y, n)), axis=1),
        n_w1=w1 + n,
        w_parts={},
    )


def covariances(plant: GeneralizedPlant, K: StateSpace) -> tuple[Array, Array, Array]:
    """Covariances E, F, W of (e, x_hat) for the observer-form controller K."""
    n = plant.sizes[0]
    L = K.B - plant.B2 @ K.D
    J = plant.A - L @ plant.C2
    A = np.block([[J, np.zeros((n, n))], [K.B @ plant.C2, J + plant.B2 @ K.C + K.B @ plant.C2]])
    P = gramian(A, np.vstack([plant.B1 - L @ plant.D21, K.B @ plant.D21]), plant.dt)
    return P[:n, :n], P[:n, n:], P[n:, n:]
