r"""What a longer controller could still gain: finite impulse response programs over Q, and lower bounds that no controller beats.

*From above* (`youla_bound`): ``min ||T11(Q)||_2`` subject to ``||T22(Q)||_inf < gamma`` over the taps of Q is convex. The constraint is set at
frequencies, the norm between them is computed from the closed loop by level sets, and peaks join the frequencies until it holds. The number of taps is
doubled until the value changes by less than half a percent. The value is the norm of a controller that exists (of high order), so it falls to the
optimum from above.

*From below* (`mixed_lower_bound`): around the H2 optimum ``||T11||^2 = f*^2 + ||Q||^2``, and the first N samples of the impulse response of T22 form a block
Toeplitz matrix whose norm is at most ``||T22||_inf``. So

.. math:: f_*^2 + \min \Big\{ \sum_{k<N} \|q_k\|^2 : \|\mathrm{Toep}_N(T_{22}(q))\| \le \gamma \Big\}

is below the square of every controller's norm, and rises to the optimum with N. In the same way `hinf_lower_bound` is below every ``||T22||_inf``.

References
----------
S. Boyd, C. Barratt, *Linear Controller Design: Limits of Performance*, Prentice Hall 1991, chapter 15.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, SynthesisError
from ...core.lti import StateSpace
from ...core.norms import h2_norm, hinf_norm
from ..generalized_plant import GeneralizedPlant
from .barrier import Block, Ending, Outcome, minimise
from .channels import part
from .youla_family import Family, markov, responses

Array = npt.NDArray[Any]
Objective = Literal["h2", "mixed", "hinf"]

_GRID, _ROUNDS, _BACK_OFF = 60, 8, 2e-4


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

    Examples
    --------
    >>> import numpy as np
    >>> from kros.synthesis import GeneralizedPlant, h2
    >>> from kros.synthesis.mixed_norms.youla import youla_bound
    >>> plant = GeneralizedPlant([[0.5]], [[1.0, 0.0]], [[1.0]], [[1.0], [0.0]], [[1.0]], np.zeros((2, 2)), [[0], [1.0]], [[0, 1.0]], [[0]], 1.0)
    >>> bool(abs(youla_bound(plant).value / h2(plant).h2_norm - 1) < 1e-6)
    True
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


def mixed_lower_bound(plant: GeneralizedPlant, gamma: float, value: float, horizon: int = 24, time_limit_s: float = 5.0) -> float:
    """Return a number that ``||T11||_2`` of no controller with ``||T22||_inf < gamma`` is below.

    Parameters
    ----------
    plant : GeneralizedPlant
        Discrete, regular in channel 1.
    gamma : float
    value : float
        H2 norm of a controller that is known: better ones have a Q of less energy, which bounds the variables.
    horizon : int
        Samples of the impulse response of T22 that count; halved where time runs out.
    time_limit_s : float
    """
    family = Family.around_h2(plant)
    _, _, free = family.energy(1)
    end = time.perf_counter() + time_limit_s
    best = float(np.sqrt(free))
    room = float(np.sqrt(max(value**2 - free, 0.0))) * 1.01 + 1e-9 * value
    for samples in (max(horizon // 4, 1), max(horizon // 2, 1), horizon):
        left = end - time.perf_counter()
        if left <= 0:
            break
        block = _toeplitz_block(family, samples, gamma)
        n = block.basis.shape[0]
        # In units of the largest Q that could still be better.
        inside = Block(block.constant, block.basis * room)
        found = minimise(np.zeros(n), [inside], np.zeros(n), Q=2 * np.eye(n), rtol=1e-3, time_limit_s=left, box=1.0 + 1e-6)
        if np.isfinite(found.lower):
            best = max(best, float(np.sqrt(free + room**2 * max(found.lower, 0.0))))
    return best


def hinf_lower_bound(plant: GeneralizedPlant, horizon: int = 24, time_limit_s: float = 5.0) -> float:
    """Return a number that ``||T22||_inf`` of no controller is below (up to the accuracy of the solver), by the norm of a Toeplitz matrix."""
    family = Family.around_h2(plant)
    block = _in_units(_toeplitz_block(family, horizon, 0.0), family)
    n, d = block.basis.shape[0], block.constant.shape[-1]
    basis = np.concatenate([block.basis, np.eye(d)[None, None]])
    c = np.zeros(n + 1)
    c[n] = 1.0
    start = np.zeros(n + 1)
    size = float(np.linalg.norm(block.constant[0], 2))
    start[n] = 1.1 * size + 1e-9
    found = minimise(c, [Block(block.constant, basis)], start, rtol=1e-3, time_limit_s=time_limit_s)
    return max(found.lower, 0.0)


def samples_infeasible(plant: GeneralizedPlant, gamma: float, horizon: int = 24, time_limit_s: float = 5.0) -> bool:
    """Tell whether the first samples of T22 alone are shown to have no norm below `gamma`; this needs no optimum, so it is quick."""
    family = Family.around_h2(plant)
    block = _in_units(_toeplitz_block(family, horizon, gamma), family)
    found = minimise(np.zeros(len(block.basis)), [block], np.zeros(len(block.basis)), time_limit_s=time_limit_s)
    return found.ending is Ending.INFEASIBLE


def _in_units(block: Block, family: Family) -> Block:
    """Taps in units of what they do to T22, so that the solver's box is no limit for controllers that hardly reach it; rounding is left out."""
    sizes = np.linalg.norm(block.basis, axis=(-2, -1)).max(axis=-1)
    _, two, three = family.channel(2)
    whole = _uncancelled(two) * _uncancelled(three)
    constant = max(float(np.linalg.norm(block.constant)), 1e-300)
    unit = np.where((sizes > 1e-13 * whole) & (sizes > 0), constant / np.where(sizes > 0, sizes, 1.0), 0.0)
    return Block(block.constant, block.basis * unit[:, None, None, None])


def _uncancelled(system: StateSpace) -> float:
    """Size of the impulse response if nothing in it cancelled; it does not depend on the units of the states."""
    size, state = float(np.linalg.norm(system.D)), system.B
    for _ in range(2 * system.n_states):
        size = max(size, float(np.linalg.norm(np.abs(system.C) @ np.abs(state))))
        state = system.A @ state
    return size


def _family(plant: GeneralizedPlant, centre: str | None) -> Family:
    if centre not in (None, "open_loop", "h2"):
        raise ConfigError(f"Youla program: centre = {centre!r} should be 'open_loop' or 'h2'.")
    fast = float(plant.open_loop().spectral_radius()) < 0.9
    return Family.around_open_loop(plant) if centre == "open_loop" or (centre is None and fast) else Family.around_h2(plant)


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
    return Block(_symmetric(toeplitz(free), gamma)[None], _symmetric(taps, 0.0)[:, None])


def _symmetric(H: Array, diagonal: float) -> Array:
    """``[[d I, H], [H', d I]]`` for a stack of matrices."""
    p, m = H.shape[-2:]
    found = np.zeros((*H.shape[:-2], p + m, p + m))
    found[..., :p, p:] = H
    found[..., p:, :p] = H.swapaxes(-1, -2)
    found += diagonal * np.eye(p + m)
    return found


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
        return _symmetric(np.concatenate([T.real, T.imag], axis=-1).reshape(*T.shape[:-2], 1, -1), diagonal)
    real = np.concatenate([np.concatenate([T.real, -T.imag], axis=-1), np.concatenate([T.imag, T.real], axis=-1)], axis=-2)
    return _symmetric(real, diagonal)
