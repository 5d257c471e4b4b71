r"""Coordinates in which the H-infinity problem is solved: continuous time, balanced states, no D22.

Discrete plants go through ``z = (1 + s) / (1 - s)``, which maps the unit circle to the imaginary axis and keeps all gains, so that nothing is
approximated.

Symbols
-------
X, Y : Riccati solutions of the H2 problem (the level infinity), from which the states are balanced, T: X = Y = diag
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError

from ...core.errors import SynthesisError
from ...core.linalg import balanced_size
from ...core.lti import StateSpace
from ...core.norms import to_continuous
from ..generalized_plant import GeneralizedPlant, split
from .equations import solve_riccati
from .h2_optimal import absorb_feedthrough
from .hinf_central import normalise

Array = npt.NDArray[Any]

_SWEEPS = 20
_POLE = 1e12  # condition beyond which a pole is at z = -1, the point that the map sends to infinity


@dataclass(frozen=True, eq=False)
class Coordinates:
    """The normalised continuous plant, and the way back to the controller of the original one."""

    plant: GeneralizedPlant
    left: Array
    right: Array
    D22_mapped: Array
    original: GeneralizedPlant

    def controller(self, K: StateSpace) -> StateSpace:
        """Return the controller of the original plant; a `SynthesisError` where the algebraic loop has no solution."""
        K = StateSpace(K.A, K.B @ self.right, self.left @ K.C, self.left @ K.D @ self.right, 0.0)
        if self.original.dt > 0:
            K = to_discrete(K, self.original.dt)
        # In discrete time, because a controller may well have a pole at z = -1, where the continuous loop would not be solvable.
        return absorb_feedthrough(absorb_feedthrough(K, self.D22_mapped), self.original.D22)


def coordinates(plant: GeneralizedPlant) -> Coordinates:
    """Map, balance and normalise a regular plant."""
    mapped = scaled(replace(plant, D22=np.zeros_like(plant.D22)))
    if (found := balancing(mapped)) is not None:
        mapped = _level_out(transformed(mapped, *found))
    if plant.dt > 0:
        if len(mapped.A) and np.linalg.cond(mapped.A + np.eye(len(mapped.A))) > _POLE:
            raise SynthesisError(
                "H-infinity synthesis: the plant has a pole at z = -1, which no bilinear map takes to continuous time; move it into the stable region."
            )
        mapped = split(to_continuous(mapped.open_loop()), plant.sizes[1], plant.sizes[3])
    normal = normalise(mapped)
    return Coordinates(normal.plant, normal.left, normal.right, mapped.D22, plant)


def to_discrete(K: StateSpace, dt: float) -> StateSpace:
    """Inverse of `to_continuous`, ``s = (z - 1) / (z + 1)``; a `SynthesisError` for a pole at s = 1, whose counterpart is not causal."""
    eye = np.eye(K.n_states)
    if K.n_states and np.linalg.cond(eye - K.A) > 1e14:
        raise SynthesisError(
            "H-infinity synthesis: the discrete controller of this level is not causal; ask for a slightly larger gamma."
        )
    solved = np.linalg.solve(eye - K.A, np.hstack([eye + K.A, K.B]))
    n = K.n_states
    output = np.linalg.solve((eye - K.A).T, K.C.T).T
    return StateSpace(solved[:, :n], np.sqrt(2) * solved[:, n:], np.sqrt(2) * output, K.D + K.C @ solved[:, n:], dt)


def scaled(p: GeneralizedPlant) -> GeneralizedPlant:
    """Scale the states by powers of two, so that A is balanced, every state is driven as much as it is seen, and B is as large as C."""
    if not p.sizes[0]:
        return p
    scale = balanced_size(p.A)
    p = _level_out(transformed(p, np.diag(1 / scale), np.diag(scale)))
    size = np.ones(len(p.A))
    for _ in range(_SWEEPS):
        q = transformed(p, np.diag(1 / size), np.diag(size))
        coupling = np.abs(q.A - np.diag(np.diag(q.A)))
        unit = max(float(np.linalg.norm(q.A)), 1e-300)
        B, C = np.hstack([q.B1, q.B2]), np.vstack([q.C1, q.C2])
        driven = np.hypot(
            np.linalg.norm(coupling, axis=1), unit * np.linalg.norm(B, axis=1) / max(float(np.linalg.norm(B)), 1e-300)
        )
        seen = np.hypot(
            np.linalg.norm(coupling, axis=0), unit * np.linalg.norm(C, axis=0) / max(float(np.linalg.norm(C)), 1e-300)
        )
        usable = (driven > 0) & (seen > 0)
        step = np.exp2(np.round(0.5 * np.log2(np.where(usable, driven, 1.0) / np.where(usable, seen, 1.0))))
        size = size * step
        if np.all(step == 1):
            break
    return _level_out(transformed(p, np.diag(1 / size), np.diag(size)))


def balancing(p: GeneralizedPlant) -> tuple[Array, Array] | None:
    """Change of the states, and its inverse, that balances the H2 Riccati solutions; None where these cannot be computed."""
    if not p.sizes[0]:
        return None
    method = "H-infinity synthesis, balancing"
    try:
        X = solve_riccati(p.A, p.B2, p.C1.T @ p.C1, p.D12.T @ p.D12, p.C1.T @ p.D12, p.dt, method)
        Y = solve_riccati(p.A.T, p.C2.T, p.B1 @ p.B1.T, p.D21 @ p.D21.T, p.B1 @ p.D21.T, p.dt, method)
        square = [_root(X, p.A, p.C1), _root(Y, p.A, p.B1)]
        U, s, Vh = np.linalg.svd(square[0].T @ square[1])
    except (SynthesisError, LinAlgError):
        return None
    return (U / np.sqrt(s)).T @ square[0].T, square[1] @ Vh.T / np.sqrt(s)


def _level_out(p: GeneralizedPlant) -> GeneralizedPlant:
    """Scale all states alike, so that B is as large as C."""
    inputs, outputs = np.linalg.norm(np.hstack([p.B1, p.B2])), np.linalg.norm(np.vstack([p.C1, p.C2]))
    if not (inputs > 0 and outputs > 0):
        return p
    eye, size = np.eye(p.sizes[0]), float(np.exp2(np.round(np.log2(outputs / inputs) / 2)))
    return transformed(p, eye * size, eye / size)


def _root(M: Array, A: Array, source: Array) -> Array:
    """Square root factor ``M = L L'`` with directions of no weight raised to a small one; the identity where M is only rounding."""
    values, vectors = np.linalg.eigh(M)
    floor = 1e-8 * max(float(values[-1]), 0.0)
    if values[-1] * max(float(np.linalg.norm(A, 2)), 1.0) <= 1e-9 * float(np.linalg.norm(source)) ** 2:
        return np.eye(len(M))
    return vectors * np.sqrt(np.maximum(values, floor))


def transformed(p: GeneralizedPlant, T: Array, back: Array) -> GeneralizedPlant:
    """Return the plant in the states ``T x``."""
    return replace(p, A=T @ p.A @ back, B1=T @ p.B1, B2=T @ p.B2, C1=p.C1 @ back, C2=p.C2 @ back)
