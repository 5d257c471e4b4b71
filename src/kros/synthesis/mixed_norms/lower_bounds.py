r"""Lower bounds that no controller of a mixed problem beats, from the family of all stabilising controllers (Youla and Kucera).

    x_hat+ = A x_hat + B2 u + L nu,   u = F x_hat + L0 nu + v,   nu = y - C2 x_hat,   v = Q nu

    T(Q) = T1 + T2 Q T3:   T2 from v to z with A + B2 F,   T3 from w to nu with A - L C2

Around the *H2 optimum* of channel 1, with v and nu divided by the roots of ``R_b`` and ``S_y``, T2 is an isometry, T3 a co-isometry and T1 orthogonal
to what Q adds, so that ``||T11(Q)||^2 = f*^2 + ||Q||^2`` exactly. The first N samples of the impulse response of T22 form a block Toeplitz matrix
whose norm is at most ``||T22||_inf``. So

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
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...core.norms import h2_norm
from ..assumptions import require
from ..generalized_plant import GeneralizedPlant
from ..riccati.equations import discrete_gain, solve_riccati
from .barrier import Block, minimise

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Family:
    """T(Q) of a discrete plant around the H2 optimum of channel 1."""

    plant: GeneralizedPlant
    F: Array
    L: Array
    L0: Array
    left: Array
    right: Array

    @classmethod
    def around_h2(cls, plant: GeneralizedPlant) -> Self:
        """Return the family around the H2 optimum of channel 1."""
        p = plant.channel(plant.rows(1), plant.columns(1))
        require(p, "Lower bound around the H2 optimum")
        R1, S1, R2, S2 = p.D12.T @ p.D12, p.C1.T @ p.D12, p.D21 @ p.D21.T, p.B1 @ p.D21.T
        X = solve_riccati(p.A, p.B2, p.C1.T @ p.C1, R1, S1, p.dt, "Lower bound, control")
        Y = solve_riccati(p.A.T, p.C2.T, p.B1 @ p.B1.T, R2, S2, p.dt, "Lower bound, filter")
        Rb, Sy = R1 + p.B2.T @ X @ p.B2, R2 + p.C2 @ Y @ p.C2.T
        F, L = discrete_gain(p.A, p.B2, R1, S1, X), -discrete_gain(p.A.T, p.C2.T, R2, S2, Y).T
        F0 = -np.linalg.solve(Rb, p.B2.T @ X @ p.B1 + p.D12.T @ p.D11)
        L0 = np.linalg.solve(Sy, (F @ Y @ p.C2.T + F0 @ p.D21.T).T).T
        left, right = np.linalg.inv(np.linalg.cholesky(Rb)).T, np.linalg.inv(np.linalg.cholesky(Sy))
        return cls(plant, F, L, L0, left, right)

    def free(self) -> StateSpace:
        """T1 with all disturbances and outputs."""
        p, F, L, L0 = self.plant, self.F, self.L, self.L0
        n = p.sizes[0]
        middle = L0 @ p.C2 - F
        return StateSpace(
            np.block([[p.A + p.B2 @ F, p.B2 @ middle], [np.zeros((n, n)), p.A - L @ p.C2]]),
            np.vstack([p.B1 + p.B2 @ L0 @ p.D21, p.B1 - L @ p.D21]),
            np.hstack([p.C1 + p.D12 @ F, p.D12 @ middle]),
            p.D11 + p.D12 @ L0 @ p.D21,
            p.dt,
        )

    def into(self) -> StateSpace:
        """T2, from the output of Q to z."""
        p = self.plant
        return StateSpace(p.A + p.B2 @ self.F, p.B2 @ self.left, p.C1 + p.D12 @ self.F, p.D12 @ self.left, p.dt)

    def out_of(self) -> StateSpace:
        """T3, from w to the input of Q."""
        p = self.plant
        return StateSpace(p.A - self.L @ p.C2, p.B1 - self.L @ p.D21, self.right @ p.C2, self.right @ p.D21, p.dt)

    def channel(self, channel: int) -> tuple[StateSpace, StateSpace, StateSpace]:
        """T1, T2 and T3 of one channel."""
        rows, columns = self.plant.rows(channel), self.plant.columns(channel)
        one, two, three = self.free(), self.into(), self.out_of()
        return (
            StateSpace(one.A, one.B[:, columns], one.C[rows], one.D[rows][:, columns], one.dt),
            StateSpace(two.A, two.B, two.C[rows], two.D[rows], two.dt),
            StateSpace(three.A, three.B[:, columns], three.C, three.D[:, columns], three.dt),
        )


def markov(family: Family, channel: int, taps: int) -> tuple[Array, Array]:
    """Impulse response of a channel without Q, (taps, p, m), and of ``T2[:, i] T3[j, :]``, (n_u n_y, taps, p, m)."""
    one, two, three = (impulse(system, taps) for system in family.channel(channel))
    products = np.zeros((two.shape[2], three.shape[1], taps, two.shape[1], three.shape[2]))
    for t in range(taps):
        for s in range(t + 1):
            products[:, :, t] += np.einsum("pi,jm->ijpm", two[s], three[t - s])
    return one, products.reshape(-1, *one.shape)


def impulse(system: StateSpace, count: int) -> Array:
    """First samples of the impulse response, shape (count, p, m)."""
    found, state = [system.D], system.B
    for _ in range(count - 1):
        found.append(system.C @ state)
        state = system.A @ state
    return np.stack(found)


def mixed_lower_bound(plant: GeneralizedPlant, gamma: float, value: float, time_limit_s: float) -> float:
    """Return a number that ``||T11||_2`` of no controller with ``||T22||_inf < gamma`` is below."""
    family = Family.around_h2(plant)
    free = h2_norm(family.channel(1)[0]) ** 2
    end = time.perf_counter() + time_limit_s
    best = float(np.sqrt(free))
    room = float(np.sqrt(max(value**2 - free, 0.0))) * 1.01 + 1e-9 * value
    for samples in (6, 12, 24):
        left = end - time.perf_counter()
        if left <= 0:
            break
        block = _toeplitz_block(family, samples, gamma)
        n = block.basis.shape[0]
        # In units of the largest Q that could still be better.
        inside = Block(block.constant, block.basis * room)
        found = minimise(
            np.zeros(n), [inside], np.zeros(n), Q=2 * np.eye(n), rtol=1e-3, time_limit_s=left, box=1.0 + 1e-6
        )
        if np.isfinite(found.lower):
            best = max(best, float(np.sqrt(free + room**2 * max(found.lower, 0.0))))
    return best


def _toeplitz_block(family: Family, samples: int, gamma: float) -> Block:
    """``[[gamma I, H], [H', gamma I]]`` with the lower triangular Toeplitz matrix H of the first samples of T22."""
    free, products = markov(family, 2, samples)
    _, p, m = free.shape

    def toeplitz(impulse: Array) -> Array:
        H = np.zeros((*impulse.shape[:-3], samples * p, samples * m))
        for t in range(samples):
            for s in range(samples - t):
                H[..., (t + s) * p : (t + s + 1) * p, s * m : (s + 1) * m] = impulse[..., t, :, :]
        return H

    delayed = np.zeros((samples, *products.shape))
    for k in range(samples):
        delayed[k, :, k:] = products[:, : samples - k]
    taps = toeplitz(delayed.reshape(-1, samples, p, m))
    return Block(symmetric(toeplitz(free), gamma)[None], symmetric(taps, 0.0)[:, None])


def symmetric(H: Array, diagonal: float) -> Array:
    """``[[d I, H], [H', d I]]`` for a stack of matrices."""
    p, m = H.shape[-2:]
    found = np.zeros((*H.shape[:-2], p + m, p + m))
    found[..., :p, p:] = H
    found[..., p:, :p] = H.swapaxes(-1, -2)
    found += diagonal * np.eye(p + m)
    return found
