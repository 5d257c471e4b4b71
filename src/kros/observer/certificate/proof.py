r"""Proof of a gain: multipliers by cutting planes, a Lyapunov matrix by a Riccati equation, an exact decision.

For slopes that move anywhere in their box the gain gamma is proven where ``T = diag(t) > 0`` and ``P = R' R > 0`` have

    F = diag(P, T, gamma^2 I) - [A, L, B]' P [A, L, B] - [M, E, D]' T [M, E, D] - [C, 0, 0]' [C, 0, 0] > 0 .

By the Kalman-Yakubovich-Popov lemma such a P exists where, with ``H = [[G_qp, G_qw], [G_zp, G_zw]]``,

    F_f(t, g) = diag(t, g I) - sum_j t_j h_fj' h_fj - H_z' H_z > 0          at every frequency f, g = gamma^2,

linear in (t, g). For one slope nothing is lost against the corners of the box (S-lemma). The least g over a grid of
frequencies is a linear program whose constraints ``v' F_f(t, g) v >= 0`` are found where they are needed; P solves the
Riccati equation of ``[sqrt(T) q, z]`` by ``[p sqrt(T), gamma w]`` with a small extra output, which makes the inequality
strict. What is returned was decided on its own: entries are rational numbers, and F is formed and found positive in
integers.

References
----------
J. E. Kelley, "The cutting-plane method for solving convex programs", J. SIAM 8 (1960) 703-712.
E. H. Bareiss, "Sylvester's identity and multistep integer-preserving Gaussian elimination", Mathematics of Computation
22 (1968) 565-578.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from ...core import EPS, ITERATED, ROUNDING, TINY, AnyArray, Array, StateSpace, frozen
from ...core.norms import first_frequencies, gramian, hinf_norm, to_continuous
from .error import ErrorSystem


@frozen
class ProofSettings:
    """How a proof is looked for; a gain that is proven is one whatever these are."""

    accuracy: float = 5e-4  # of the least squared gain on the grid
    rounds: int = 60  # of cutting planes
    cuts: int = 30  # of a round
    above: int = 3  # decimals of 1.001, the first multiple of the least gain on the grid that is tried; 2 is the last
    spare: float = 0.25  # share of the distance to one that the extra output may take
    corners: int = 64  # of a box, which are visited where slopes are frozen


SETTINGS = ProofSettings()
_DIGITS = np.finfo(float).nmant + 1  # binary, of a number
_BITS = 2 * _DIGITS  # of the scaled matrix that is decided on; the rounding to them is subtracted


@frozen
class Proof:
    """A gain with the Lyapunov factor ``P = R'R``, shape (n, n), and multipliers, shape (n_p,)."""

    gain: float
    root: Array
    multipliers: Array


def first_proof(system: ErrorSystem) -> Proof | None:
    """Return the first proposal that is proven; None where there is none."""
    every = proposals(system)
    return next((p for p in every if proven(p.root, *system.multiplied(p.multipliers, p.gain), p.gain)), None)


def proven_gain(system: ErrorSystem) -> float:
    """Return a proven gain of a system, infinite where there is none."""
    proof = first_proof(system)
    return np.inf if proof is None else proof.gain


def frozen_gain(system: ErrorSystem) -> float:
    """Return the largest gain that slopes frozen at a corner or in the middle attain."""
    return max(hinf_norm(system.frozen(place)) for place in _places(system))


def growing_place(system: ErrorSystem) -> str:
    """Return where frozen slopes let the error grow; empty where they do not."""
    radius = max(system.frozen(place).spectral_radius() for place in _places(system))
    return f"The error grows: with constant slopes, by a factor of {radius:.6g} per step." if radius >= 1 else ""


def _places(system: ErrorSystem) -> list[Array]:
    """Return the middle of the box, and its corners where they are not too many."""
    width = system.L.shape[1]
    visited = width > 0 and 2**width <= SETTINGS.corners
    return [np.zeros(width), *(np.array(c) for c in product((-1.0, 1.0), repeat=width) if visited)]


def proposals(system: ErrorSystem) -> Iterator[Proof]:
    """Yield proposals, best first; none where the frequency inequality has no solution."""
    plain, width = system.frozen(np.zeros(system.L.shape[1])), system.L.shape[1]
    if not plain.is_stable():
        return
    multipliers: Array | None = np.ones(width)
    if width and np.any(system.C) and (np.any(system.B) or np.any(system.D)):
        H = _responses(system)
        multipliers = best_multipliers(H, width)
        least = np.inf if multipliers is None else float(np.sqrt(gain_squared(H, multipliers)))
    else:
        least = hinf_norm(plain)
    if multipliers is None or not np.isfinite(least):
        return
    size = float(np.linalg.norm(system.B) * np.linalg.norm(system.C))
    least = max(least, ROUNDING * size, TINY)  # nothing arrives: any will do
    for decimals in range(
        SETTINGS.above, -1, -1
    ):  # multipliers that grow with the gain leave room for what the grid did not see
        factor = 1 + 10.0**-decimals
        R = lyapunov_factor(system, multipliers * factor, least * factor)
        if R is not None:
            yield Proof(least * factor, R, multipliers * factor)


def best_multipliers(H: AnyArray, width: int) -> Array | None:
    """Return multipliers, (n_p,), of nearly the least gain for responses (f, ., .); None where none prove stability."""
    from scipy.optimize import linprog

    unit, H = _scaled(H, width)
    cuts, best, least, query, known = np.zeros((0, width + 2)), None, np.inf, np.ones(width), 0.0
    for _ in range(SETTINGS.rounds):
        level = gain_squared(H, query)
        if level < least:
            best, least = query, level
        if least <= known * (1 + SETTINGS.accuracy):
            break
        cuts = np.vstack([cuts, _cuts(H, query, known)])
        result = linprog([*np.zeros(width), 1.0], -cuts[:, :-1], -cuts[:, -1], bounds=(0, 1 / EPS))
        if result.status != 0:
            break
        known = float(result.x[-1])
        query = result.x[:-1] if best is None else (result.x[:-1] + best) / 2
    return None if best is None else best * unit


def _scaled(H: AnyArray, width: int) -> tuple[Array, AnyArray]:
    """Return units of the multipliers, and responses in which these and the squared gain are of size one."""
    through = np.sqrt(np.max(np.sum(np.abs(H[:, width:, :width]) ** 2, axis=1), axis=0))
    by_slopes = through @ np.sqrt(np.max(np.sum(np.abs(H[:, :width, width:]) ** 2, axis=2), axis=0))
    size = max(float(np.linalg.norm(H[:, width:, width:], 2, axis=(1, 2)).max()), float(by_slopes)) or 1.0
    through = np.maximum(through, ROUNDING * size)
    H = H / np.concatenate([through, np.full(H.shape[2] - width, size)])
    H[:, :width] *= through[:, None]
    return through**2, H


def _cuts(H: AnyArray, t: Array, g: float) -> Array:
    """Return rows (c, n_p + 2) of ``v' F_f(t, g) v = a t + b g - c`` for the eigenvectors of least value."""
    width = len(t)
    F = np.diag(np.append(t, np.full(H.shape[2] - width, g))) - _forms(H, t)
    values, vectors = np.linalg.eigh(F)
    some = np.argsort(values[:, 0])[: SETTINGS.cuts]
    v = vectors[some, :, 0]
    moved = np.abs((H[some] @ v[..., None])[..., 0]) ** 2
    size = np.abs(v) ** 2
    return np.column_stack(
        [size[:, :width] - moved[:, :width], size[:, width:].sum(axis=1), moved[:, width:].sum(axis=1)]
    )


def _forms(H: AnyArray, t: Array) -> AnyArray:
    """Return ``sum_j t_j h_fj' h_fj + H_z' H_z`` at every frequency."""
    weight = np.append(t, np.ones(H.shape[1] - len(t)))
    return np.conj(np.swapaxes(H, 1, 2)) @ (weight[:, None] * H)


def gain_squared(H: AnyArray, t: Array) -> float:
    """Return the least g that multipliers allow on the grid, by a Schur complement, or infinity."""
    width = len(t)
    F = _forms(H, t)
    rest = np.diag(t) - F[:, :width, :width]
    if not np.linalg.eigvalsh(rest)[:, 0].min() > 0:
        return np.inf
    schur = F[:, width:, width:] + F[:, width:, :width] @ np.linalg.solve(rest, F[:, :width, width:])
    return float(np.linalg.eigvalsh(schur)[:, -1].max())


def _responses(system: ErrorSystem) -> AnyArray:
    """H at the frequencies at which `hinf_norm` begins; shape (f, n_p + n_z, n_p + n_w)."""
    C, D = np.vstack([system.M, system.C]), np.hstack([np.broadcast_to(system.E, 2 * (system.L.shape[1],)), system.D])
    D = np.vstack([D, np.zeros((len(system.C), D.shape[1]))])
    plant = StateSpace(system.A, np.hstack([system.L, system.B]), C, D, system.dt)
    nu = first_frequencies(to_continuous(plant).poles())
    return plant.frequency_response(np.unique(np.append(np.arctan(nu) / (np.pi * system.dt), 0.5 / system.dt)))


def lyapunov_factor(system: ErrorSystem, multipliers: Array, gain: float) -> Array | None:
    """Return the triangular factor of a Lyapunov matrix for a gain, or None without a solution."""
    from scipy.linalg import solve_discrete_are

    (A, inputs), outputs, feed = system.multiplied(multipliers, gain)
    inputs, feed, n = inputs / gain, feed / gain, len(A)
    W = gramian(A, inputs, system.dt)
    if not np.isfinite(W).all():
        return None
    T, back = coordinates(W)
    A, inputs, outputs = np.eye(n) + back @ (A - np.eye(n)) @ T, back @ inputs, outputs @ T
    room = 1 - (hinf_norm(StateSpace(A, inputs, outputs, feed, system.dt), ITERATED) * (1 + ITERATED)) ** 2
    if room <= 0:
        return None
    spread = hinf_norm(StateSpace(A, inputs, np.eye(n), np.zeros((n, inputs.shape[1])), system.dt), 1e-2)
    extra = SETTINGS.spare * room / max(spread, TINY) ** 2
    Q, W = outputs.T @ outputs + extra * np.eye(n), feed.T @ feed - np.eye(inputs.shape[1])
    try:
        R = np.linalg.cholesky(solve_discrete_are(A, inputs, Q, W, s=outputs.T @ feed)).T
    except (np.linalg.LinAlgError, ValueError):
        return None
    return np.asarray(np.linalg.qr(R @ back, mode="r"))


def coordinates(W: Array) -> tuple[Array, Array]:
    """Return T and its inverse, for coordinates in which a Gramian W is the identity."""
    size = np.sqrt(np.maximum(np.diag(W), 0.0))
    size[size == 0] = 1.0
    values, vectors = np.linalg.eigh(W / np.outer(size, size))
    root = np.sqrt(np.maximum(values, ROUNDING * values.max()))
    return size[:, None] * vectors * root, (vectors / root).T / size


def proven(root: Array, inputs: tuple[Array, Array], C: Array, D: Array, gain: float) -> bool:
    """Whether ``diag(R'R, gain^2 I) - [A, B]' R'R [A, B] - [C, D]' [C, D] > 0`` for the numbers as they are stored."""
    parts = [root, np.hstack(inputs), np.hstack([C, D]), np.array([[gain]])]
    if not all(np.isfinite(part).all() for part in parts):
        return False
    shift = max(_DIGITS, *(_DIGITS - int(np.frexp(part)[1].min(initial=0)) for part in parts))
    R, AB, CD, level = (_integers(part, shift) for part in parts)
    moved, n = R @ AB, len(root)
    F = -moved.T @ moved - ((CD.T @ CD) << (2 * shift))
    F[:n, :n] += (R.T @ R) << (2 * shift)
    rest = range(n, len(F))
    F[rest, rest] += (level[0, 0] ** 2) << (2 * shift)
    return positive(F)


def _integers(matrix: Array, shift: int) -> AnyArray:
    """Return ``2^shift`` times a matrix of doubles, as integers without rounding."""
    mantissa, exponent = np.frexp(matrix)
    whole = (mantissa * 2.0**_DIGITS).astype(np.int64).astype(object)
    return np.asarray(whole << (exponent - _DIGITS + shift).astype(object), dtype=object)


def positive(F: AnyArray) -> bool:
    """Whether a symmetric matrix of integers is positive definite, by elimination without rounding."""
    n = len(F)
    if any(F[i, i] <= 0 for i in range(n)):
        return False
    half = [int(F[i, i]).bit_length() // 2 for i in range(n)]
    M = np.empty((n, n), dtype=object)
    for i, j in np.ndindex(n, n):  # diagonal entries of alike size, few bits
        M[i, j] = (int(F[i, j]) << _BITS) >> (half[i] + half[j])
    M[range(n), range(n)] -= n
    pivot = 1
    for k in range(n):
        if M[k, k] <= 0:
            return False
        M[k + 1 :, k + 1 :] = (M[k, k] * M[k + 1 :, k + 1 :] - np.outer(M[k + 1 :, k], M[k, k + 1 :])) // pivot
        pivot = M[k, k]
    return True
