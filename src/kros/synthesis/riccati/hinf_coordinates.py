r"""Coordinates in which the H-infinity problem is solved: continuous time, balanced states, no D22.

Discrete plants go through ``z = (1 + s) / (1 - s)``, which maps the unit circle to the imaginary axis and keeps all gains, so that nothing is
approximated. A pole at the point that goes to infinity (z = -1) is moved first by a constant output feedback, ``u = u' + K0 y``, or the
plant is mirrored, ``z -> -z``; both are undone in the controller.

Symbols
-------
X, Y : Riccati solutions of the H2 problem (the level infinity), from which the states are balanced, T: X = Y = diag
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, matrix_balance

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.norms import to_continuous
from ..generalized_plant import GeneralizedPlant, split
from ..reduction.balancing import Balancing, gramian_root
from .equations import solve_riccati
from .h2_optimal import absorb_feedthrough
from .hinf_central import normalise

Array = npt.NDArray[Any]

_SWEEPS = 20


@dataclass(frozen=True, eq=False)
class Coordinates:
    """The normalised continuous plant, and the way back to the controller of the original one."""

    plant: GeneralizedPlant
    left: Array
    right: Array
    D22_mapped: Array
    constant: Array
    mirrored: bool
    original: GeneralizedPlant

    def controller(self, K: StateSpace) -> StateSpace:
        """Return the controller of the original plant.

        Raises
        ------
        SynthesisError
            When the algebraic loop has no solution.
        """
        K = StateSpace(K.A, K.B @ self.right, self.left @ K.C, self.left @ K.D @ self.right, 0.0)
        if self.original.dt > 0:
            K = to_discrete(K, self.original.dt)
            if self.mirrored:
                K = StateSpace(-K.A, -K.B, K.C, K.D, K.dt)
        # In discrete time, because a controller may well have a pole at z = -1, where the continuous loop would not be solvable.
        K = absorb_feedthrough(K, self.D22_mapped)
        K = StateSpace(K.A, K.B, K.C, K.D + self.constant, K.dt)
        return absorb_feedthrough(K, self.original.D22)


class Balance(str, Enum):
    """How the states are balanced; what one way spoils another may save."""

    LOOP = "Riccati solutions of the H2 problem"
    PLANT = "Gramians of a stable plant, by square roots"
    SCALES = "powers of two only"


def coordinates(plant: GeneralizedPlant, balance: Balance = Balance.LOOP) -> Coordinates:
    """Map, balance and normalise a regular plant."""
    strict = replace(plant, D22=np.zeros_like(plant.D22))
    better = _balance_plant(strict) if balance is Balance.PLANT else scaled(strict)
    if balance is Balance.LOOP and (found := balancing(better)) is not None:
        better = _level_out(transformed(better, *found))
    constant, mirrored, mapped = np.zeros(plant.D22.T.shape), False, better
    if plant.dt > 0:
        constant, mirrored, mapped = _best_map(better)
    normal = normalise(mapped)
    return Coordinates(normal.plant, normal.left, normal.right, mapped.D22, constant, mirrored, plant)


def to_discrete(K: StateSpace, dt: float) -> StateSpace:
    """Inverse of `to_continuous`: ``s = (z - 1) / (z + 1)``.

    Raises
    ------
    SynthesisError
        When the controller has a pole at s = 1: its discrete counterpart would not be causal.
    """
    eye = np.eye(K.n_states)
    if K.n_states and np.linalg.cond(eye - K.A) > 1e14:
        raise SynthesisError("H-infinity synthesis: the discrete controller of this level is not causal; ask for a slightly larger gamma.")
    solved = np.linalg.solve(eye - K.A, np.hstack([eye + K.A, K.B]))
    n = K.n_states
    output = np.linalg.solve((eye - K.A).T, K.C.T).T
    return StateSpace(solved[:, :n], np.sqrt(2) * solved[:, n:], np.sqrt(2) * output, K.D + K.C @ solved[:, n:], dt)


def _best_map(plant: GeneralizedPlant) -> tuple[Array, bool, GeneralizedPlant]:
    """Best conditioned of a few bilinear maps: direct, mirrored, and both after a constant feedback."""
    rng = np.random.default_rng(0)
    n_u, n_y = plant.sizes[2], plant.sizes[4]
    size = 1 / max(float(np.linalg.norm(plant.B2) * np.linalg.norm(plant.C2)), 1e-300)
    best: tuple[float, Array, bool, GeneralizedPlant] | None = None
    for trial in range(4):
        constant = 0.3 * size * rng.standard_normal((n_u, n_y)) if trial else np.zeros((n_u, n_y))
        for mirrored in (False, True):
            shifted = _feed_back(plant, constant)
            if mirrored:
                shifted = replace(shifted, A=-shifted.A, B1=-shifted.B1, B2=-shifted.B2)
            distance = _distance(shifted.A)
            if distance > 1e14:
                continue
            mapped = _continuous(shifted)
            quality = max(distance, _condition(mapped.D12), _condition(mapped.D21))
            # A feedback or a mirror must earn its place: by a factor of 100.
            if best is None or quality < best[0] / 100:
                best = quality, constant, mirrored, mapped
    if best is None:
        raise SynthesisError(
            "H-infinity synthesis: the plant has poles at both z = 1 and z = -1 that no feedback moves; remove them from the weights."
        )
    return best[1:]


def _feed_back(p: GeneralizedPlant, K: Array) -> GeneralizedPlant:
    """Close ``u = u' + K y`` around a plant with D22 = 0."""
    if not K.any():
        return p
    return replace(
        p,
        A=p.A + p.B2 @ K @ p.C2,
        B1=p.B1 + p.B2 @ K @ p.D21,
        C1=p.C1 + p.D12 @ K @ p.C2,
        D11=p.D11 + p.D12 @ K @ p.D21,
    )


def _continuous(p: GeneralizedPlant) -> GeneralizedPlant:
    return split(to_continuous(p.open_loop()), p.sizes[1], p.sizes[3])


def scaled(p: GeneralizedPlant) -> GeneralizedPlant:
    """Scale the states by powers of two, so that A is balanced, every state is driven as much as it is seen, and B is as large as C."""
    if not p.sizes[0]:
        return p
    _, (scale, _) = matrix_balance(p.A, permute=False, separate=True)
    p = _level_out(transformed(p, np.diag(1 / scale), np.diag(scale)))
    size = np.ones(len(p.A))
    for _ in range(_SWEEPS):
        q = transformed(p, np.diag(1 / size), np.diag(size))
        coupling = np.abs(q.A - np.diag(np.diag(q.A)))
        unit = max(float(np.linalg.norm(q.A)), 1e-300)
        B, C = np.hstack([q.B1, q.B2]), np.vstack([q.C1, q.C2])
        driven = np.hypot(np.linalg.norm(coupling, axis=1), unit * np.linalg.norm(B, axis=1) / max(float(np.linalg.norm(B)), 1e-300))
        seen = np.hypot(np.linalg.norm(coupling, axis=0), unit * np.linalg.norm(C, axis=0) / max(float(np.linalg.norm(C)), 1e-300))
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


def _balance_plant(p: GeneralizedPlant) -> GeneralizedPlant:
    """Balance the Gramians of the plant, where these exist and can be computed; states without effect are dropped."""
    p = scaled(p)
    system = p.open_loop()
    if not p.sizes[0] or not system.is_stable():
        return p
    with np.errstate(over="ignore", invalid="ignore"):
        roots = gramian_root(p.A, system.B, p.dt), gramian_root(p.A.T, system.C.T, p.dt)
    if not all(np.isfinite(root).all() for root in roots):
        return p  # so close to the boundary that rounding in A decides
    balancing = Balancing.of(*roots)
    return _level_out(transformed(p, balancing.left, balancing.right))


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


def _distance(A: Array) -> float:
    """Size of A over its distance from a pole at -1, which the map sends to infinity."""
    if not A.size:
        return 1.0
    smallest = float(np.linalg.svd(A + np.eye(len(A)), compute_uv=False)[-1])
    return (1 + float(np.linalg.norm(A, 2))) / max(smallest, 1e-300)


def _condition(matrix: Array) -> float:
    return float(np.linalg.cond(matrix)) if matrix.size else 1.0
