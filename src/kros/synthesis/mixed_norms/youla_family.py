r"""All stabilising controllers of a plant around one of them: the closed loop is affine in a free stable filter Q (Youla and Kucera).

    x_hat+ = A x_hat + B2 u + L nu,   u = F x_hat + L0 nu + v,   nu = y - C2 x_hat,   v = Q nu

    T(Q) = T1 + T2 Q T3:   T2 from v to z with A + B2 F,   T3 from w to nu with A - L C2

Around the *open loop* of a stable plant F = L = L0 = 0, and T(Q) = P11 + P12 Q P21. Around the *H2 optimum* of channel 1, with v and nu divided by the
roots of ``R_b`` and ``S_y``, T2 is an isometry, T3 a co-isometry and T1 orthogonal to what Q adds, so that

.. math:: \|T_{11}(Q)\|_2^2 = \|T_{11}(0)\|_2^2 + \|Q\|_2^2

exactly: the H2 norm costs nothing to compute. It needs no stable plant, and its poles are fast where those of a sampled plant are slow.

References
----------
S. Boyd, C. Barratt, *Linear Controller Design: Limits of Performance*, Prentice Hall 1991, chapters 7 and 15.

Symbols
-------
q : taps of Q, shape (taps, n_u, n_y), Q = sum q_k z^-k
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.norms import gramian
from ..assumptions import require
from ..generalized_plant import GeneralizedPlant
from ..riccati.equations import discrete_gain, solve_riccati
from ..riccati.h2_optimal import absorb_feedthrough

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Family:
    """T(Q) of a discrete plant; `orthonormal` when the squared H2 norm of channel 1 is that of T1 plus that of Q."""

    plant: GeneralizedPlant
    F: Array
    L: Array
    L0: Array
    left: Array
    right: Array
    orthonormal: bool

    @classmethod
    def around_open_loop(cls, plant: GeneralizedPlant) -> Family:
        """Return the family of a stable plant with Q from y - P22 u to u."""
        if not plant.open_loop().is_stable():
            raise SynthesisError(
                f"Youla program: the plant has spectral radius {float(plant.open_loop().spectral_radius()):.6g}; "
                "an unstable plant needs centre = 'h2'."
            )
        n, _, n_u, _, n_y = plant.sizes
        return cls(plant, np.zeros((n_u, n)), np.zeros((n, n_y)), np.zeros((n_u, n_y)), np.eye(n_u), np.eye(n_y), False)

    @classmethod
    def around_h2(cls, plant: GeneralizedPlant) -> Family:
        """Return the family around the H2 optimum of channel 1."""
        p = plant.channel(plant.rows(1), plant.columns(1))
        require(p, "Youla program around the H2 optimum")
        R1, S1, R2, S2 = p.D12.T @ p.D12, p.C1.T @ p.D12, p.D21 @ p.D21.T, p.B1 @ p.D21.T
        X = solve_riccati(p.A, p.B2, p.C1.T @ p.C1, R1, S1, p.dt, "Youla program, control")
        Y = solve_riccati(p.A.T, p.C2.T, p.B1 @ p.B1.T, R2, S2, p.dt, "Youla program, filter")
        Rb, Sy = R1 + p.B2.T @ X @ p.B2, R2 + p.C2 @ Y @ p.C2.T
        F, L = discrete_gain(p.A, p.B2, R1, S1, X), -discrete_gain(p.A.T, p.C2.T, R2, S2, Y).T
        F0 = -np.linalg.solve(Rb, p.B2.T @ X @ p.B1 + p.D12.T @ p.D11)
        L0 = np.linalg.solve(Sy, (F @ Y @ p.C2.T + F0 @ p.D21.T).T).T
        left, right = np.linalg.inv(np.linalg.cholesky(Rb)).T, np.linalg.inv(np.linalg.cholesky(Sy))
        return cls(plant, F, L, L0, left, right, True)

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
        """T1, T2 and T3 of one channel; channel 0 is the whole."""
        if channel == 0:
            return self.free(), self.into(), self.out_of()
        rows, columns = self.plant.rows(channel), self.plant.columns(channel)
        one, two, three = self.free(), self.into(), self.out_of()
        return (
            StateSpace(one.A, one.B[:, columns], one.C[rows], one.D[rows][:, columns], one.dt),
            StateSpace(two.A, two.B, two.C[rows], two.D[rows], two.dt),
            StateSpace(three.A, three.B[:, columns], three.C, three.D[:, columns], three.dt),
        )

    def controller(self, q: Array) -> StateSpace:
        """Controller of the plant for the taps q; n + (taps - 1) n_y states."""
        p, (taps, _, n_y) = self.plant, q.shape
        n = p.sizes[0]
        Q = self.left @ q @ self.right
        shift = np.eye((taps - 1) * n_y, k=-n_y)
        enter, tail = np.eye((taps - 1) * n_y, n_y), np.hstack([*Q[1:], np.zeros((Q.shape[1], 0))])
        direct = self.L0 + Q[0]
        C = np.hstack([self.F - direct @ p.C2, tail])
        B = np.vstack([self.L + p.B2 @ direct, enter])
        A = np.block([[p.A - self.L @ p.C2, np.zeros((n, shift.shape[0]))], [-enter @ p.C2, shift]])
        A[:n] += p.B2 @ C
        return absorb_feedthrough(StateSpace(A, B, C, direct, p.dt), p.D22)

    def energy(self, taps: int) -> tuple[Array, Array, float]:
        """Squared H2 norm of channel 1 as ``q'Hq + 2 g'q + c`` over the flattened taps, exact (by Gramians, not by truncated responses)."""
        one, two, three = self.channel(1)
        P = gramian(one.A, one.B, one.dt)
        constant = float(np.trace(one.C @ P @ one.C.T) + np.sum(one.D**2))
        n_u, n_y = two.n_inputs, three.n_outputs
        if self.orthonormal:
            return np.eye(taps * n_u * n_y), np.zeros(taps * n_u * n_y), constant
        bank = [StateSpace(two.A, two.B[:, [i]], two.C, two.D[:, [i]], two.dt) @ _row(three, j) for i in range(n_u) for j in range(n_y)]
        forward, backward = _correlations([*bank, one], taps)
        m = len(bank)
        H = np.zeros((taps, m, taps, m))
        for k in range(taps):
            for j in range(taps):
                H[k, :, j] = forward[j - k, :m, :m] if j >= k else forward[k - j, :m, :m].T
        return H.reshape(taps * m, taps * m), backward[:, :m, m].ravel(), constant


def responses(family: Family, channel: int, freqs_hz: Array, taps: int) -> tuple[Array, Array]:
    """Frequency response of a channel without Q, (f, p, m), and what each tap adds, (taps n_u n_y, f, p, m)."""
    one, two, three = (system.frequency_response(freqs_hz) for system in family.channel(channel))
    delay = np.exp(-2j * np.pi * np.outer(np.arange(taps), freqs_hz) * family.plant.dt)
    products = np.einsum("kf,fpi,fjm->kijfpm", delay, two, three)
    return one, products.reshape(-1, *one.shape)


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


def _row(system: StateSpace, j: int) -> StateSpace:
    return replace(system, C=system.C[[j]], D=system.D[[j]])


def _correlations(systems: list[StateSpace], lags: int) -> tuple[Array, Array]:
    """``sum_t tr h_a(t + m) h_b(t)'`` and ``sum_t tr h_a(t) h_b(t + m)'`` of systems with a common input, each (lags, a, b)."""
    from scipy.linalg import block_diag

    A, B = block_diag(*(s.A for s in systems)), np.vstack([s.B for s in systems])
    ends = np.cumsum([s.n_states for s in systems])
    C = np.zeros((len(systems), systems[0].n_outputs, len(A)))
    for a, s in enumerate(systems):
        C[a, :, ends[a] - s.n_states : ends[a]] = s.C
    D = np.stack([s.D for s in systems])
    P = gramian(A, B, systems[0].dt)
    found = np.zeros((lags, len(systems), len(systems)))
    found[0] = np.einsum("apx,xy,bpy->ab", C, P, C) + np.einsum("apm,bpm->ab", D, D)
    state = np.einsum("xy,bpy->bxp", A @ P, C) + np.einsum("xm,bpm->bxp", B, D)
    for m in range(1, lags):
        found[m] = np.einsum("apx,bxp->ab", C, state)
        state = A @ state
    return found, found.swapaxes(-1, -2)
