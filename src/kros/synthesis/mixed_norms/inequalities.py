"""Matrix inequalities of discrete mixed H2/H-infinity synthesis, with one Lyapunov matrix for both channels.

With the Lyapunov matrix ``G`` partitioned as the plant and the controller, ``G = [[X, *], [U, *]]`` and ``G^-1 = [[Y,
*], [V', *]]``, the change of variables

    C_n = D^c C2 X + C^c U,   B_n = Y B2 D^c + V B^c,   D_n = D^c,   I = Y X + V U,
    A_n = Y (A + B2 D^c C2) X + V B^c C2 X + Y B2 C^c U + V A^c U - I

makes ``G~ = [[X, I], [I, Y]]`` and the closed-loop matrices A~, B~, C~, D~ affine. Sampled plants have A close to I,
and then the inequality between G~ and A~ is a small difference of large matrices. So the unknown is ``W = A~ - G~`` and
the rows are combined accordingly (a congruence):

    H2:    [[-W-W', W, B~1], [., G~, 0], [., ., I]] > 0,   [[Z, C~1, D~11], [., G~, 0], [., ., I]] > 0,   min tr Z
    Hinf:  [[-W-W', W, B~2, -C~2'], [., G~, 0, C~2'], [., ., I, D~22'], [., ., ., I]] > 0

In balanced coordinates G~ has the diagonal (s, s); rows and columns are
divided by its root.

Symbols
-------
X, Y, A_n, B_n, C_n, D_n, Z : the variables

References
----------
C. Scherer, P. Gahinet, M. Chilali, IEEE Trans. Automatic Control 42 (1997) 896-911.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.linalg import cholesky, inv, solve, svd

from ...core import EPS, TINY, AnyArray, StateSpace, frozen
from ...core.norms import gramian, h2_norm
from ..generalized_plant import GeneralizedPlant
from ..riccati.h2 import balancing, h2
from .barrier import Block

_MARGIN = 1e-3  # least eigenvalue of the scaled Lyapunov matrices, which keeps I - Y X regular
_KNOWN = 1e-3  # error, in a state's standard deviations, that stands for that of a state known exactly
Values = dict[str, AnyArray]


@frozen
class MixedInequalities:
    """The inequalities of a plant (D22 = 0) in balanced coordinates, z1 divided by `norm`, for any solver."""

    plant: GeneralizedPlant
    norm: float
    spread: AnyArray  # diagonal of X and Y to expect
    controls: AnyArray
    measurements: AnyArray

    @classmethod
    def of(cls, plant: GeneralizedPlant) -> MixedInequalities:
        """Balance a regular plant (D22 = 0) in the coordinates (error, estimate) of its H2-optimal observer.

        An accurate sensor makes the error ``e = x - x_hat`` of the optimal estimate many decades smaller than the
        state, so nothing here subtracts one covariance from another: those of e, of x_hat and between them are E, W and
        F, and ``X = E + F + F' + W`` is that of x. T makes ``X = E^-1 = diag(s)``.
        """
        n = plant.sizes[0]
        performance = plant.channel(plant.rows(1), slice(None))
        K = h2(performance).controller
        L = K.B - plant.B2 @ K.D  # predictor gain: e+ = (A - L C2) e + ...
        A = np.block([[plant.A - L @ plant.C2, np.zeros((n, n))], [K.B @ plant.C2, K.A + K.B @ plant.C2]])
        P = gramian(A, np.vstack([plant.B1 - L @ plant.D21, K.B @ plant.D21]), plant.dt)
        E, X = P[:n, :n], P.reshape(2, n, 2, n).sum(axis=(0, 2))
        X = X + _KNOWN**2 * np.diag(np.where(np.diag(X) > 0, 0.0, np.diag(X).max(initial=1.0)))
        E = E + _KNOWN**2 * np.diag(np.where(np.diag(E) > EPS**2 * np.diag(X), 0.0, np.diag(X)))
        T, back, s = balancing(cholesky(X), inv(cholesky(E)).T)
        norm, scale = h2_norm(performance.close(K)), np.ones(plant.sizes[3])
        scale[plant.rows(1)] = 1 / max(norm, TINY)
        measurements = np.sqrt(np.diag(plant.C2 @ E @ plant.C2.T + plant.D21 @ plant.D21.T))
        controls = norm / np.linalg.norm(performance.D12, axis=0)
        changes = {"z": np.diag(scale), "y": np.diag(1 / measurements), "u": np.diag(controls)}
        return cls(plant.transformed(x=(T, back), **changes), norm, s, controls, measurements)

    @cached_property
    def places(self) -> Values:
        """Number of the scalar variable behind every entry of every variable."""
        n, _, n_u, _, n_y = self.plant.sizes
        n_z1 = len(self.plant.C1[self.plant.rows(1)])
        shapes = {"X": (n, n), "Y": (n, n), "An": (n, n), "Bn": (n, n_y), "Cn": (n_u, n), "Dn": (n_u, n_y)}
        shapes["Z"] = n_z1, n_z1
        places, size = {}, 0
        for name, (rows, columns) in shapes.items():
            place = np.arange(rows * columns).reshape(rows, columns)
            if name in ("X", "Y", "Z"):  # symmetric
                upper, place = np.triu_indices(rows), np.zeros((rows, rows), int)
                place[upper] = np.arange(len(upper[0]))
                place = np.maximum(place, place.T)
            places[name] = size + place
            size += place.max(initial=-1) + 1
        return places

    @property
    def size(self) -> int:
        """Number of scalar variables."""
        return 1 + max(place.max(initial=-1) for place in self.places.values())

    def values(self, x: AnyArray) -> Values:
        """Matrices from scalar variables, shape (..., n); the leading axes stay."""
        return {name: x[..., place] for name, place in self.places.items()}

    def start(self) -> AnyArray:
        """Variables of no correction, with the Lyapunov matrices that are expected."""
        x, places = np.zeros(self.size), self.places
        x[places["X"]] = x[places["Y"]] = 2 * np.diag(self.spread)
        x[places["Z"]] = 2 * np.eye(len(places["Z"]))
        return x

    def objective(self) -> AnyArray:
        """Coefficients of tr Z."""
        return np.bincount(np.diag(self.places["Z"]), minlength=self.size).astype(float)

    def blocks(self) -> list[Block]:
        """Return the inequalities as affine functions of the scalar variables."""
        constants, whole = self._matrices(np.zeros((1, self.size))), self._matrices(np.eye(self.size))
        return [Block(c, (m - c)[:, None]) for c, m in zip(constants, whole, strict=True)]

    def _matrices(self, x: AnyArray) -> list[AnyArray]:
        """Matrices of all inequalities at the points x, shape (k, n); each (k, d, d)."""
        p, v = self.plant, self.values(x)
        n, eye = p.sizes[0], np.eye(p.sizes[0])
        scale = 1 / np.sqrt(np.concatenate([self.spread] * 2))
        frame = scale[:, None] * scale
        less = p.A - eye
        G = frame * _blocks([[v["X"], eye], [eye, v["Y"]]])
        W = frame * _blocks(
            [[less @ v["X"] + p.B2 @ v["Cn"], less + p.B2 @ v["Dn"] @ p.C2], [v["An"], v["Y"] @ less + v["Bn"] @ p.C2]]
        )
        Wt = W.swapaxes(-1, -2)
        blocks = [G - _MARGIN * np.eye(2 * n)]
        for channel, part in enumerate((p.performance, p.uncertainty), 1):
            B, C, D = _channel(part, v, scale)
            Bt, Ct, Dt, one = (m.swapaxes(-1, -2) for m in (B, C, D, np.eye(B.shape[-1])))
            zero = np.zeros((2 * n, B.shape[-1]))
            if channel == 1:
                blocks.append(_blocks([[-W - Wt, W, B], [Wt, G, zero], [Bt, zero.T, one]]))
                blocks.append(_blocks([[v["Z"], C, D], [Ct, G, zero], [Dt, zero.T, one]]))
            else:
                level = np.eye(C.shape[-2])
                blocks.append(
                    _blocks([[-W - Wt, W, B, -Ct], [Wt, G, zero, Ct], [Bt, zero.T, one, Dt], [-C, C, D, level]])
                )
        return blocks

    def controller(self, x: AnyArray) -> StateSpace:
        """Controller of the plant before balancing (for D22 = 0) from the variables; ``V U = I - Y X``."""
        p, v = self.plant, self.values(x)
        X, Y, Bn, Cn, Dn = (v[name] for name in ("X", "Y", "Bn", "Cn", "Dn"))
        eye = np.eye(len(X))
        left, s, right = svd(eye - Y @ X)
        V, U = left * np.sqrt(s), np.sqrt(s)[:, None] * right
        C = solve(U.T, (Cn - Dn @ p.C2 @ X).T).T
        B = solve(V, Bn - Y @ p.B2 @ Dn)
        middle = v["An"] + eye - V @ B @ p.C2 @ X - Y @ p.B2 @ C @ U - Y @ (p.A + p.B2 @ Dn @ p.C2) @ X
        A = solve(V, solve(U.T, middle.T).T)
        return StateSpace(A, B, C, Dn, p.dt).multiplied(self.controls, 1 / self.measurements)


def _channel(p: GeneralizedPlant, v: Values, scale: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
    """B~, C~, D~ of one channel, scaled; disturbances without effect on it are left out."""
    p = p.channel(slice(None), np.any(np.vstack([p.B1, p.D21, p.D11]), axis=0))
    B = np.concatenate([p.B1 + p.B2 @ v["Dn"] @ p.D21, v["Y"] @ p.B1 + v["Bn"] @ p.D21], axis=-2)
    C = np.concatenate([p.C1 @ v["X"] + p.D12 @ v["Cn"], p.C1 + p.D12 @ v["Dn"] @ p.C2], axis=-1)
    return scale[:, None] * B, C * scale, p.D11 + p.D12 @ v["Dn"] @ p.D21


def _blocks(rows: list[list[AnyArray]]) -> AnyArray:
    """Block matrix of stacks of matrices, whose leading axes are broadcast."""
    batch = np.broadcast_shapes(*(m.shape[:-2] for row in rows for m in row))
    wide = [np.concatenate([np.broadcast_to(m, (*batch, *m.shape[-2:])) for m in row], axis=-1) for row in rows]
    return np.concatenate(wide, axis=-2)
