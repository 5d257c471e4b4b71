r"""Lower bounds of mixed problems, from the family of all stabilising controllers (Youla and Kucera).

    x_hat+ = A x_hat + B2 u + L nu,   u = F x_hat + L0 nu + v,   nu = y - C2 x_hat,   v = Q nu

    T(Q) = T1 + T2 Q T3:   T2 from v to z with A + B2 F,   T3 from w to nu with A - L C2

Around the *H2 optimum* of channel 1, with v and nu divided by the roots of ``R_b`` and ``S_y``, T2 is an isometry, T3 a
co-isometry and T1 orthogonal to what Q adds, so that ``||T11(Q)||^2 = f*^2 + ||Q||^2`` exactly. The first N samples of
the impulse response of T22 form a block Toeplitz matrix whose norm is at most ``||T22||_inf``. So

.. math:: f_*^2 + \min \Big\{ \sum_{k<N} \|q_k\|^2 : \|\mathrm{Toep}_N(T_{22}(q))\| \le \gamma \Big\}

is below the square of every controller's norm, and rises to the optimum with N.

References
----------
S. Boyd, C. Barratt, *Linear Controller Design: Limits of Performance*, Prentice Hall 1991, chapters 7 and 15.

Symbols
-------
q : taps of Q, shape (taps, n_u, n_y), Q = sum q_k z^-k
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...core.norms import h2_norm
from ..generalized_plant import GeneralizedPlant
from ..riccati.h2 import Gains
from .barrier import Block, minimise

Array = npt.NDArray[Any]


def family(plant: GeneralizedPlant) -> tuple[StateSpace, StateSpace, StateSpace]:
    """T1, T2 and T3 of a discrete plant around the H2 optimum of channel 1, with all disturbances and outputs."""
    p, g = plant, Gains.of(plant.performance, "Lower bound")
    n, middle = p.sizes[0], g.L0 @ p.C2 - g.F
    left, right = np.linalg.inv(np.linalg.cholesky(g.R_b)).T, np.linalg.inv(np.linalg.cholesky(g.S_y))
    free = StateSpace(
        np.block([[p.A + p.B2 @ g.F, p.B2 @ middle], [np.zeros((n, n)), p.A - g.L @ p.C2]]),
        np.vstack([p.B1 + p.B2 @ g.L0 @ p.D21, p.B1 - g.L @ p.D21]),
        np.hstack([p.C1 + p.D12 @ g.F, p.D12 @ middle]),
        p.D11 + p.D12 @ g.L0 @ p.D21,
        p.dt,
    )
    into = StateSpace(p.A + p.B2 @ g.F, p.B2 @ left, p.C1 + p.D12 @ g.F, p.D12 @ left, p.dt)
    return free, into, StateSpace(p.A - g.L @ p.C2, p.B1 - g.L @ p.D21, right @ p.C2, right @ p.D21, p.dt)


def mixed_lower_bound(plant: GeneralizedPlant, gamma: float, value: float, time_limit_s: float) -> float:
    """Return a number that ``||T11||_2`` of no controller with ``||T22||_inf < gamma`` is below."""
    parts = family(plant)
    free = h2_norm(_of_channel(plant, 1, parts)[0]) ** 2
    end = time.perf_counter() + time_limit_s
    best = float(np.sqrt(free))
    room = float(np.sqrt(max(value**2 - free, 0.0))) * 1.01 + 1e-9 * value
    for samples in (6, 12, 24):
        left = end - time.perf_counter()
        if left <= 0:
            break
        block = _toeplitz_block(_of_channel(plant, 2, parts), samples, gamma)
        n = len(block.basis)
        # In units of the largest Q that could still be better.
        inside, Q = Block(block.constant, block.basis * room), 2 * np.eye(n)
        solved = minimise(np.zeros(n), [inside], np.zeros(n), Q=Q, rtol=1e-3, time_limit_s=left, box=1.0 + 1e-6)
        if np.isfinite(solved.lower):
            best = max(best, float(np.sqrt(free + room**2 * max(solved.lower, 0.0))))
    return best


def _of_channel(
    plant: GeneralizedPlant, channel: int, parts: tuple[StateSpace, StateSpace, StateSpace]
) -> tuple[StateSpace, StateSpace, StateSpace]:
    """T1, T2 and T3 of one channel."""
    rows, columns = plant.rows(channel), plant.columns(channel)
    one, two, three = parts
    return (
        StateSpace(one.A, one.B[:, columns], one.C[rows], one.D[rows][:, columns], one.dt),
        StateSpace(two.A, two.B, two.C[rows], two.D[rows], two.dt),
        StateSpace(three.A, three.B[:, columns], three.C, three.D[:, columns], three.dt),
    )


def _toeplitz_block(parts: tuple[StateSpace, StateSpace, StateSpace], samples: int, gamma: float) -> Block:
    """``[[gamma I, H], [H', gamma I]]`` with the lower triangular Toeplitz matrix H of the first samples of T22."""
    one, two, three = (_impulse(system, samples) for system in parts)
    _, p, m = one.shape
    products = np.zeros((two.shape[2], three.shape[1], samples, p, m))  # impulse response of T2[:, i] T3[j, :]
    for t in range(samples):
        for s in range(t + 1):
            products[:, :, t] += np.einsum("pi,jm->ijpm", two[s], three[t - s])
    delayed = np.zeros((samples, *products.shape))
    for k in range(samples):
        delayed[k, :, :, k:] = products[:, :, : samples - k]
    taps = _toeplitz(delayed.reshape(-1, samples, p, m))
    return Block(_symmetric(_toeplitz(one), gamma)[None], _symmetric(taps, 0.0)[:, None])


def _impulse(system: StateSpace, count: int) -> Array:
    """First samples of the impulse response, shape (count, p, m)."""
    samples, state = [system.D], system.B
    for _ in range(count - 1):
        samples.append(system.C @ state)
        state = system.A @ state
    return np.stack(samples)


def _toeplitz(impulse: Array) -> Array:
    """Lower triangular block Toeplitz matrices of impulse responses (..., samples, p, m)."""
    samples, p, m = impulse.shape[-3:]
    H = np.zeros((*impulse.shape[:-3], samples * p, samples * m))
    for t in range(samples):
        for s in range(samples - t):
            H[..., (t + s) * p : (t + s + 1) * p, s * m : (s + 1) * m] = impulse[..., t, :, :]
    return H


def _symmetric(H: Array, diagonal: float) -> Array:
    """``[[d I, H], [H', d I]]`` for a stack of matrices."""
    p, m = H.shape[-2:]
    whole = np.zeros((*H.shape[:-2], p + m, p + m))
    whole[..., :p, p:], whole[..., p:, :p] = H, H.swapaxes(-1, -2)
    return whole + diagonal * np.eye(p + m)
