r"""What a longer controller could still gain: finite impulse response programs over Q, an upper bound beside the lower ones of `kros`.

``min ||T11(Q)||_2`` subject to ``||T22(Q)||_inf < gamma`` over the taps of Q is convex. The constraint is set at frequencies, the norm between them is
computed from the closed loop by level sets, and peaks join the frequencies until it holds. The number of taps is doubled until the value changes by
less than half a percent. The value is the norm of a controller that exists (of high order), so it falls to the optimum from above. Around the
*open loop* of a stable plant F = L = L0 = 0, and T(Q) = P11 + P12 Q P21.

S. Boyd, C. Barratt, *Linear Controller Design: Limits of Performance*, Prentice Hall 1991, chapters 7 and 15.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from kros.core.errors import ConfigError, SynthesisError
from kros.core.lti import StateSpace
from kros.core.norms import gramian, h2_norm, hinf_norm
from kros.synthesis.generalized_plant import GeneralizedPlant
from kros.synthesis.mixed_norms import lower_bounds
from kros.synthesis.mixed_norms.barrier import Block, Ending, Outcome, minimise
from kros.synthesis.mixed_norms.channels import part
from kros.synthesis.mixed_norms.lower_bounds import symmetric
from kros.synthesis.riccati.h2_optimal import absorb_feedthrough

Array = npt.NDArray[Any]
Objective = Literal["h2", "mixed", "hinf"]

_GRID, _ROUNDS, _BACK_OFF = 60, 8, 2e-4


@dataclass(frozen=True, eq=False)
class Family(lower_bounds.Family):
    """All stabilising controllers, around the open loop too; `orthonormal` around the H2 optimum."""

    orthonormal: bool = True

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
        pairs = [StateSpace(two.A, two.B[:, [i]], two.C, two.D[:, [i]], two.dt) @ _row(three, j) for i in range(n_u) for j in range(n_y)]
        forward, backward = _correlations([*pairs, one], taps)
        m = len(pairs)
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


def _row(system: StateSpace, j: int) -> StateSpace:
    return replace(system, C=system.C[[j]], D=system.D[[j]])


def _correlations(systems: list[StateSpace], lags: int) -> tuple[Array, Array]:
    """``sum_t tr h_a(t + m) h_b(t)'`` and ``sum_t tr h_a(t) h_b(t + m)'`` of systems with a common input, each (lags, a, b)."""
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


@dataclass(frozen=True, eq=False)
class YoulaBound:
    """The value, the number of taps, the controller that attains it, its recomputed norms, and the values of shorter filters."""

    value: float
    taps: int
    controller: StateSpace
    h2_norm: float
    hinf_norm: float
    history: tuple[tuple[int, float], ...]
    converged: bool


def youla_bound(
    plant: GeneralizedPlant,
    taps: int = 8,
    objective: Objective = "h2",
    hinf_bound: float | None = None,
    *,
    centre: Literal["open_loop", "h2"] | None = None,
    max_taps: int = 128,
    change: float = 5e-3,
    time_limit_s: float = 60.0,
) -> YoulaBound:
    """Return an upper bound of the optimum over controllers of any order, with a controller that attains it.

    Parameters
    ----------
    plant : GeneralizedPlant
        Discrete. The H2 norm is that of channel 1, the H-infinity norm that of channel 2; without a partition both are the whole plant.
    taps : int
        Number of taps to begin with; doubled until the value changes by less than `change`.
    objective : "h2", "mixed" or "hinf"
        ``min ||T11||_2``, the same with ``||T22||_inf < hinf_bound``, or ``min ||T22||_inf``.
    hinf_bound : float
        For ``mixed``.
    centre : "open_loop" or "h2", optional
        The controller around which Q is. Default the open loop for plants with a spectral radius below 0.9, else the H2 optimum of channel 1.
    max_taps : int
    change : float
        Relative change of the value at which the doubling ends.
    time_limit_s : float

    Returns
    -------
    YoulaBound
        ``converged`` is False where taps or time ran out first; the value is a bound all the same.

    Raises
    ------
    ConfigError
        When an option is out of range.
    SynthesisError
        For a continuous plant, an unstable one around the open loop, or when no filter of this length meets the bound.
    """
    if objective not in ("h2", "mixed", "hinf") or taps < 1 or max_taps < taps or not change > 0 or not time_limit_s > 0:
        raise ConfigError(
            f"Youla program: objective = {objective!r} should be 'h2', 'mixed' or 'hinf', and taps = {taps}, max_taps = {max_taps}, "
            f"change = {change}, time_limit_s = {time_limit_s} positive."
        )
    if objective == "mixed" and not (hinf_bound is not None and hinf_bound > 0):
        raise ConfigError(f"Youla program: hinf_bound = {hinf_bound} should be positive for the mixed objective.")
    if plant.dt == 0:
        raise SynthesisError("Youla program: works in discrete time, found a continuous plant (dt = 0); sample it.")
    family = _family(plant, centre)
    undivided = plant.n_w1 is None and plant.n_z1 is None
    end = time.perf_counter() + time_limit_s
    history: list[tuple[int, float]] = []
    best: tuple[float, int, StateSpace, float, float] | None = None
    converged, reason = False, ""
    level = np.inf if hinf_bound is None else float(hinf_bound)
    while taps <= max_taps and time.perf_counter() < end:
        found = _Program(family, taps, objective, level, undivided, end).solve()
        if isinstance(found, str):
            reason = found
        else:
            value, K, h2_value, hinf_value = found
            history.append((taps, value))
            if best is None or value < best[0]:
                best = (value, taps, K, h2_value, hinf_value)
            if len(history) > 1 and abs(history[-2][1] - value) <= change * value:
                converged = True
                break
        taps *= 2
    if best is None:
        raise SynthesisError(
            f"Youla program: no filter of up to {taps // 2} taps was found ({reason or 'time limit'}); raise hinf_bound, max_taps or the time limit."
        )
    return YoulaBound(*best, history=tuple(history), converged=converged)


def _family(plant: GeneralizedPlant, centre: str | None) -> Family:
    if centre not in (None, "open_loop", "h2"):
        raise ConfigError(f"Youla program: centre = {centre!r} should be 'open_loop' or 'h2'.")
    fast = float(plant.open_loop().spectral_radius()) < 0.9
    return Family.around_open_loop(plant) if centre == "open_loop" or (centre is None and fast) else Family.around_h2(plant)


@dataclass(frozen=True, eq=False)
class _Program:
    """The convex program for one number of taps."""

    family: Family
    taps: int
    objective: str
    level: float
    undivided: bool
    end: float

    def solve(self) -> tuple[float, StateSpace, float, float] | str:
        """Return value, controller and both recomputed norms; or why there is none."""
        H, g, constant = self.family.energy(self.taps)
        if self.objective == "h2":
            return self._judge(np.linalg.lstsq(H, -g, rcond=None)[0])
        freqs_hz = _frequencies(self.family)
        start, target, kept = np.zeros(len(g)), 1 - _BACK_OFF, None
        reason = "the constraint is not met between the frequencies"
        for _ in range(_ROUNDS):
            found = self._minimise(H, g, constant, freqs_hz, start, target)
            if found.x is None:
                return f"{self.taps} taps: {found.ending.value}" if kept is None else kept
            q = found.x[: len(g)]
            judged = self._judge(q)
            if self.objective == "hinf":
                kept = judged if kept is None or judged[0] < kept[0] else kept
                if judged[3] <= found.x[-1] * (1 + 1e-3):
                    return kept
            elif judged[3] < self.level:
                return judged
            elif judged[3] < 1.02 * self.level:
                target *= min(1.0, self.level / judged[3]) * (1 - _BACK_OFF)
            freqs_hz = np.union1d(freqs_hz, self._peaks(q))
            start = q
            if found.ending is Ending.TIME:
                reason = "time limit"
                break
        return reason if kept is None else kept

    def _minimise(self, H: Array, g: Array, constant: float, freqs_hz: Array, start: Array, target: float) -> Outcome:
        one, products = responses(self.family, 2 if not self.undivided else 0, freqs_hz, self.taps)
        scale = max(np.sqrt(abs(constant)), 1e-300)
        left = max(self.end - time.perf_counter(), 1e-3)
        if self.objective == "mixed":
            block = Block(_embedded(one, self.level * target), _embedded(products, 0.0))
            return minimise(2 * g / scale**2, [block], start, Q=2 * H / scale**2, rtol=1e-5, time_limit_s=left)
        size = float(np.linalg.norm(one, 2, axis=(-2, -1)).max())
        basis = np.concatenate([_embedded(products, 0.0), _embedded(np.zeros((1, *one.shape)), 1.0)])
        point = np.append(start, 0.0)
        now = one + np.tensordot(start, products, 1)
        point[-1] = 1.1 * float(np.linalg.norm(now, 2, axis=(-2, -1)).max()) + 1e-9
        c = np.zeros(len(point))
        c[-1] = 1.0 / max(size, 1e-300)
        return minimise(c, [Block(_embedded(one, 0.0), basis)], point, rtol=1e-4, time_limit_s=left)

    def _judge(self, q: Array) -> tuple[float, StateSpace, float, float]:
        plant = self.family.plant
        K = self.family.controller(q.reshape(self.taps, plant.sizes[2], plant.sizes[4]))
        closed = plant.close(K)
        one, two = (closed, closed) if self.undivided else (part(plant, closed, 1), part(plant, closed, 2))
        first = h2_norm(one)
        second = hinf_norm(two) if two.n_inputs and two.n_outputs else 0.0
        return (second if self.objective == "hinf" else first), K, first, second

    def _peaks(self, q: Array) -> Array:
        dense = _frequencies(self.family, 500)
        one, products = responses(self.family, 2 if not self.undivided else 0, dense, self.taps)
        size = np.linalg.norm(one + np.tensordot(q, products, 1), 2, axis=(-2, -1))
        padded = np.concatenate([[-np.inf], size, [-np.inf]])
        local = (size >= padded[:-2]) & (size >= padded[2:]) & (size > 0.98 * size.max())
        return dense[local]


def _frequencies(family: Family, count: int = _GRID) -> Array:
    top = 0.5 / family.plant.dt
    return np.unique(np.concatenate([np.linspace(0, top, count), np.geomspace(1e-4 * top, top, count // 2)]))


def _embedded(T: Array, diagonal: float) -> Array:
    """Real symmetric matrices that are positive semidefinite when ``sigma_max(T) <= diagonal``; affine in T and the diagonal."""
    p, m = T.shape[-2:]
    if min(p, m) == 1:
        return symmetric(np.concatenate([T.real, T.imag], axis=-1).reshape(*T.shape[:-2], 1, -1), diagonal)
    real = np.concatenate([np.concatenate([T.real, -T.imag], axis=-1), np.concatenate([T.imag, T.real], axis=-1)], axis=-2)
    return symmetric(real, diagonal)
