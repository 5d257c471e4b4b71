r"""One Lyapunov matrix from a Riccati equation: the cheap method, and for a single slope the whole answer.

A common quadratic Lyapunov function over all slopes in the box follows where multipliers ``T = diag(t) > 0`` exist with

    sum |z|^2 + t_j (|q_j|^2 - |p_j|^2) - gamma^2 |w|^2 <= 0        on every trajectory with |p_j| <= |q_j|,

and for one channel the S-lemma makes the converse true: nothing is lost against the corners. By the
Kalman-Yakubovich-Popov lemma this is

    H(theta)* [[T, 0], [0, I]] H(theta) < [[T, 0], [0, gamma^2 I]],     H = [[G_qp, G_qw], [G_zp, G_zw]]

at all frequencies, an inequality in (T, gamma^2) alone, whatever the order. The least gamma over a grid of frequencies
is found first; the Lyapunov matrix then solves the Riccati equation of the scaled system [sqrt(T) q, z] / [p sqrt(T),
gamma w] with a small extra output that makes the inequality strict in every direction.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...core.norms import gramian, hinf_norm
from .error import ErrorSystem
from .multipliers import best_multipliers

Array = npt.NDArray[np.float64]
_GRID = 200
_NOTHING = 1e-12
_STEPS = (1.001, 1.003, 1.01, 1.03, 1.1, 1.3, 2.0)
_SPARE = 0.25  # share of the distance to one that the extra output may take
_TOLERANCE = 1e-8
_FLOOR = 1e-12
_REFINEMENTS = 2
_DOUBLINGS = 60


@dataclass(frozen=True, eq=False)
class Proposal:
    """A gain, not proven yet, with the Lyapunov factor ``P = R'R``, shape (n, n), and multipliers, shape (n_p,)."""

    gain: float
    root: Array
    multipliers: Array


def riccati_proposals(system: ErrorSystem) -> Iterator[Proposal]:
    """Yield proposals, best first; none where the frequency inequality has no solution."""
    if not _plain(system).is_stable():
        return
    multipliers, least = frequency_bound(system)
    if not np.isfinite(least):
        return
    size = float(np.linalg.norm(system.B) * np.linalg.norm(system.C))
    least = max(least, _NOTHING * size, np.finfo(float).tiny)  # where nothing arrives, any small gain will do
    for factor in _STEPS:
        # Multipliers that grow with the gain leave room for what the grid did not see.
        R = lyapunov_factor(system, multipliers * factor, least * factor)
        if R is not None:
            yield Proposal(least * factor, R, multipliers * factor)


def frequency_bound(system: ErrorSystem) -> tuple[Array, float]:
    """Return the best multipliers, (n_p,), and the least gain they allow on a grid, infinity where none do."""
    width = system.L.shape[1]
    if not width or not np.any(system.C) or not np.any(np.hstack([system.B.ravel(), system.D.ravel()])):
        return np.ones(width), hinf_norm(_plain(system))
    H = _responses(system)
    found = best_multipliers(H, width)
    return (np.ones(width), np.inf) if found is None else (found, float(np.sqrt(_level(H, found))))


def lyapunov_factor(system: ErrorSystem, multipliers: Array, gain: float) -> Array | None:
    """Return the triangular factor of a Lyapunov matrix for a gain, or None without a solution."""
    from scipy.linalg import solve_discrete_are

    width = system.L.shape[1]
    root = np.sqrt(multipliers)
    inputs = np.hstack([system.L / root, system.B / gain])
    outputs = np.vstack([root[:, None] * system.M, system.C])
    feed = np.zeros((len(outputs), inputs.shape[1]))
    feed[:width, :width], feed[:width, width:] = root[:, None] * system.nested / root, root[:, None] * system.D / gain
    T, back = reachable_coordinates(system.A, inputs, system.dt)
    n = len(T)
    A, inputs, outputs = np.eye(n) + back @ (system.A - np.eye(n)) @ T, back @ inputs, outputs @ T
    room = 1 - (hinf_norm(StateSpace(A, inputs, outputs, feed, system.dt), _TOLERANCE) * (1 + _TOLERANCE)) ** 2
    if room <= 0:
        return None
    spread = hinf_norm(StateSpace(A, inputs, np.eye(n), np.zeros((n, inputs.shape[1])), system.dt), 1e-2)
    extra = np.sqrt(_SPARE * room) / max(spread, np.finfo(float).tiny)
    Q = outputs.T @ outputs + extra**2 * np.eye(n)
    S, W = outputs.T @ feed, feed.T @ feed - np.eye(inputs.shape[1])
    try:
        P = solve_discrete_are(A, inputs, Q, W, s=S)
        for _ in range(_REFINEMENTS):
            P = _newton_step(P, A, inputs, Q, W, S)
        R = np.linalg.cholesky(P).T
    except (np.linalg.LinAlgError, ValueError):
        return None
    return np.asarray(np.linalg.qr(R @ back, mode="r"))


def reachable_coordinates(A: Array, B: Array, dt: float) -> tuple[Array, Array]:
    """Return T and its inverse, for coordinates in which a reachability Gramian is the identity."""
    W = gramian(A, B, dt)
    size = np.sqrt(np.maximum(np.diag(W), 0.0))
    size[size == 0] = 1.0
    values, vectors = np.linalg.eigh(W / np.outer(size, size))
    root = np.sqrt(np.maximum(values, _FLOOR * values.max()))
    return size[:, None] * vectors * root, (vectors / root).T / size


def _newton_step(P: Array, A: Array, B: Array, Q: Array, W: Array, S: Array) -> Array:
    """Refine a stabilising solution: the Stein equation of its closed loop, summed by doubling."""
    K = -np.linalg.solve(W + B.T @ P @ B, B.T @ P @ A + S.T)
    closed, total = A + B @ K, Q + S @ K + K.T @ S.T + K.T @ W @ K
    for _ in range(_DOUBLINGS):
        step = closed.T @ total @ closed
        total = total + step
        if np.abs(step).max(initial=0.0) <= 1e-17 * np.abs(total).max(initial=0.0):
            break
        closed = closed @ closed
    return np.asarray((total + total.T) / 2)


def _plain(system: ErrorSystem) -> StateSpace:
    """Return the system from w to z with slopes in the middle."""
    return system.frozen(np.zeros(system.L.shape[1]))


def _responses(system: ErrorSystem) -> Array:
    """H at many frequencies: those of the poles and a logarithmic grid; shape (f, n_p + n_z, n_p + n_w)."""
    C, D = np.vstack([system.M, system.C]), np.hstack([system.nested, system.D])
    D = np.vstack([D, np.zeros((len(system.C), D.shape[1]))])
    plant = StateSpace(system.A, np.hstack([system.L, system.B]), C, D, system.dt)
    poles = np.log(plant.poles().astype(complex) + 1e-300)
    nyquist = 0.5 / system.dt
    angle, width = np.abs(poles.imag), np.abs(poles.real)
    beside = np.maximum(angle + np.multiply.outer([-1.0, -0.5, 0.5, 1.0], width), 0.0).ravel()
    marks = np.concatenate([angle, width, np.abs(poles), beside]) / (2 * np.pi * system.dt)
    grid = np.geomspace(max(min(marks[marks > 0].min(initial=nyquist), nyquist) / 30, 1e-9 * nyquist), nyquist, _GRID)
    return plant.frequency_response(np.unique(np.concatenate([[0.0], grid, marks[marks <= nyquist]])))


def _level(H: Array, multipliers: Array) -> float:
    """Return the least gamma^2 that multipliers allow on the grid, by a Schur complement, or infinity."""
    width = len(multipliers)
    weight = np.concatenate([multipliers, np.ones(H.shape[1] - width)])
    F = np.conj(np.swapaxes(H, 1, 2)) @ (weight[:, None] * H)
    rest = np.diag(multipliers) - F[:, :width, :width]
    if np.linalg.eigvalsh(rest)[:, 0].min() <= 0:
        return np.inf
    schur = F[:, width:, width:] + F[:, width:, :width] @ np.linalg.solve(rest, F[:, :width, width:])
    return float(np.linalg.eigvalsh(schur)[:, -1].max())
