r"""Worst-case H-infinity norm of an observer: exact at every frequency, proven at all of them.

With the ball of `ball`, ``P = T R_l``, ``Q = R_r M`` and ``A = [T X_c M, T_n]``, the error is ``e = A (w1, n) + P s + P_r s_r`` where all that is known of
``s`` and ``s_r`` is ``|s| <= |Q w1|`` and ``|s_r| <= |Q_r w1|`` (``r`` for the remainder). By the S-procedure, lossless for up to two constraints on
complex vectors (the structured singular value equals its bound for three full blocks, performance being the third),

.. math:: \gamma^2 = \min_{\tau, \tau_r} \lambda_{max}\Big(A^H (I - PP^H/\tau - P_rP_r^H/\tau_r)^{-1} A
          + \begin{bmatrix} \tau Q^HQ + \tau_r Q_r^HQ_r & 0 \\ 0 & 0 \end{bmatrix}\Big).

Every feasible pair gives a valid bound. A largest gain is attained at one frequency, where a causal perturbation can do what any other can
(an all-pass filter takes any phase there), so *this number is exact for causal perturbations too*.

*Between frequencies.* For given multipliers the bound is below gamma exactly where the largest singular value of the rational system

    diag(1, sqrt(tau), sqrt(tau_r)) (z1, z2, z3) <- (w1, n, w2, w3) diag(1/gamma, 1/gamma, 1/sqrt(tau), 1/sqrt(tau_r))

is below one, and it can cross one only at the imaginary eigenvalues of a Hamiltonian matrix. The walk takes the multipliers that are best at
a frequency, goes as far up as they hold, takes new ones there, and so on to Nyquist: no frequency is left out. Where the worst case is nearly
the same over a wide band, multipliers hold over short steps alone, and a larger margin is taken.

References
----------
A. Packard and J. Doyle, "The complex structured singular value", Automatica 29 (1993) 71-109, section 9.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...core.linalg import adjoint
from ...core.lti import StateSpace
from ...core.norms import crossings, gramian, to_continuous
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import generalized_plant
from .disturbance import design_grid, uncertain_ball

Array = npt.NDArray[Any]

_SEARCH = 40
_MARGINS = (1e-3, 5e-2)  # by which the level exceeds what was found, so that every step of the walk gets somewhere
_ROUNDS, _FINER = 3, 20
_WALK = 100


@dataclass(frozen=True)
class RobustGain:
    """Worst-case H-infinity norm.

    Parameters
    ----------
    value : float
        No member of the set has a larger gain at any frequency.
    attained : float
        Gain that some member has at `freq_hz`; the difference is the margin of the proof.
    freq_hz : float, Hz

    Examples
    --------
    >>> from kros.synthesis import RobustGain
    >>> RobustGain(value=0.41, attained=0.40, freq_hz=3.0).freq_hz
    3.0
    """

    value: float
    attained: float
    freq_hz: float


@dataclass(frozen=True, eq=False)
class _Constraint:
    """``e = A w + P s + P_r s_r`` per frequency, first columns of A being those of w1."""

    A: Array
    P: tuple[Array, ...]
    Q: tuple[Array, ...]

    @classmethod
    def of(cls, problem: ObserverProblem, loop: StateSpace, freqs_hz: Array) -> _Constraint:
        m, n = problem.nominal.n_inputs, problem.nominal.n_states
        response = loop.frequency_response(freqs_hz)
        T = response[..., problem.uncertainty_input] @ problem.W_L.frequency_response(freqs_hz)
        ball = uncertain_ball(problem, freqs_hz)
        noise = response[..., m + n :]
        noise = noise[..., np.concatenate([np.full(len(problem.C), True), problem.scaled_process_noise > 0])]
        P: tuple[Array, ...] = (T @ ball.left,)
        Q: tuple[Array, ...] = (ball.right,)
        if problem.remainder_left is not None and problem.remainder_right is not None:
            P += (response[..., m : m + n] @ problem.remainder_left.frequency_response(freqs_hz),)
            Q += ((problem.remainder_right @ problem.input_weight).frequency_response(freqs_hz),)
        return cls(np.concatenate([T @ ball.center, noise], axis=-1), P, Q)

    def squared(self, log_tau: Array) -> Array:
        """Bound of the squared gain for multipliers (f, constraints); infinite where they are not feasible."""
        f, p, w = self.A.shape
        tau = np.exp(log_tau)
        slack = np.broadcast_to(np.eye(p, dtype=complex), (f, p, p))
        extra = np.zeros((f, w, w), complex)
        m = self.Q[0].shape[-1]
        for k, (P, Q) in enumerate(zip(self.P, self.Q, strict=True)):
            slack = slack - P @ adjoint(P) / tau[:, k, None, None]
            extra[:, :m, :m] += tau[:, k, None, None] * (adjoint(Q) @ Q)
        values, vectors = np.linalg.eigh(slack)
        feasible = values[:, 0] > 1e-12
        inverse = 1 / np.sqrt(np.where(feasible[:, None], values, 1.0))
        half = inverse[..., None] * (adjoint(vectors) @ self.A)
        return np.where(feasible, np.linalg.eigvalsh(adjoint(half) @ half + extra)[:, -1], np.inf)

    def vanishes(self) -> bool:
        """Tell whether nothing reaches the error; a rational response that is zero at a whole grid is zero everywhere."""
        return not self.A.any() and not any(
            (P.any(axis=(-2, -1)) & Q.any(axis=(-2, -1))).any() for P, Q in zip(self.P, self.Q, strict=True)
        )

    def best(self) -> tuple[Array, Array]:
        """Smallest bound, shape (f,), and its multipliers, shape (f, constraints): a compass search on a convex function."""
        size = np.linalg.norm(self.A, 2, axis=(-2, -1)) + 1e-300
        reach = [
            np.linalg.norm(P, 2, axis=(-2, -1)) * np.linalg.norm(Q, 2, axis=(-2, -1)) + 1e-300 for P, Q in zip(self.P, self.Q, strict=True)
        ]
        total = size + sum(reach)
        through = [np.linalg.norm(Q, 2, axis=(-2, -1)) + 1e-300 for Q in self.Q]
        # for scalars: tau q^2 = |p q| (|a| + |p q| + |p_r q_r|) is optimal
        point = np.stack([np.log(np.maximum(r * total / q**2, 1e-200)) for r, q in zip(reach, through, strict=True)], axis=-1)
        value, step = self.squared(point), np.full(len(size), 1.0)
        directions = np.vstack([np.eye(len(reach)), -np.eye(len(reach))])
        for _ in range(_SEARCH):
            moved = np.zeros(len(size), bool)
            for direction in directions:
                tried = point + step[:, None] * direction
                found = self.squared(tried)
                better = found < value
                point, value = np.where(better[:, None], tried, point), np.where(better, found, value)
                moved |= better
            step = np.where(moved, step, step / 3)
            if step.max() < 1e-3:
                break
        return np.sqrt(value), point


def robust_gain(problem: ObserverProblem, controller: StateSpace) -> RobustGain:
    """Return the worst-case H-infinity norm from (w1, n) to ``W_p e`` for any filter.

    Parameters
    ----------
    problem : ObserverProblem
    controller : StateSpace
        In physical units.

    Raises
    ------
    SynthesisError
        When the set is not well posed, the nominal observer loop is unstable, or the proof does not get through.

    Examples
    --------
    >>> from kros.core import StateSpace, gain
    >>> from kros.synthesis import ObserverProblem, robust_gain
    >>> lag = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01)
    >>> problem = ObserverProblem(lag, [[1.0]], gain([[0.1]], 0.01), gain([[1.0]], 0.01), [1.0], [1.0], [0.1])
    >>> found = robust_gain(problem, gain([[0.2]], 0.01))
    >>> found.attained <= found.value < 1.01 * found.attained
    True
    """
    problem.require_sound()
    loop = problem.error_system(controller)
    if not loop.is_stable():
        raise SynthesisError(
            f"Certificate: the nominal observer loop has spectral radius {float(loop.spectral_radius()):.9g}; no bound is finite."
        )
    freqs = _first_grid(problem, loop)
    constraint = _Constraint.of(problem, loop, freqs)
    if constraint.vanishes():
        return RobustGain(0.0, 0.0, 0.0)
    gains, _ = constraint.best()
    for _ in range(_ROUNDS):
        k = int(np.argmax(gains))
        finer = np.linspace(freqs[max(k - 1, 0)], freqs[min(k + 1, len(freqs) - 1)], _FINER + 2)[1:-1]
        more, _ = _Constraint.of(problem, loop, finer).best()
        freqs, index = np.unique(np.concatenate([freqs, finer]), return_index=True)
        gains = np.concatenate([gains, more])[index]
    found, freq_hz = float(gains.max()), float(freqs[np.argmax(gains)])
    for margin in _MARGINS:
        proof = _walk(problem, loop, controller, found, freq_hz, margin)
        if proof is not None:
            return proof
    raise SynthesisError(
        f"Certificate: the worst-case gain of {found:.6g} at {freq_hz:.6g} Hz could not be proven at all frequencies; a pole is extremely close "
        "to the unit circle."
    )


def _first_grid(problem: ObserverProblem, loop: StateSpace) -> Array:
    """DC, Nyquist, a logarithmic grid, and the frequencies of all poles."""
    dt = problem.nominal.dt
    systems = [loop, problem.W_L, problem.M, problem.N, problem.remainder_left, problem.remainder_right]
    poles = np.concatenate([s.poles() for s in systems if s is not None]).astype(complex)
    angles = np.abs(np.angle(poles[np.abs(poles) > 1e-3])) / (2 * np.pi * dt)
    return np.unique(np.concatenate([[0.0], design_grid(problem)[::4], angles, [0.5 / dt]]))


def _walk(
    problem: ObserverProblem, loop: StateSpace, controller: StateSpace, found: float, freq_hz: float, margin: float
) -> RobustGain | None:
    """Prove the level from DC to Nyquist; raise it where a frequency in between turns out to be worse. None when it takes too many steps."""
    plant = generalized_plant(problem)
    closed = to_continuous(_evened(plant.close(problem.to_scaled(controller))))
    dt = problem.nominal.dt
    rows = np.concatenate([np.full(size, {"z2": 0, "z3": 1}.get(name, -1)) for name, size in plant.z_parts.items()])
    columns = np.concatenate([np.full(size, {"w2": 0, "w3": 1}.get(name, -1)) for name, size in plant.w_parts.items()])
    level, nu = found * (1 + margin), 0.0
    log_tau: Array | None = None
    for _ in range(_WALK):
        scaling = _Scaling(rows, columns, level)
        response = closed.frequency_response([nu / (2 * np.pi)])[0]
        log_tau, size = (None, np.inf) if log_tau is None else _calmest(scaling, response, log_tau)
        warm = size < 1 - margin / 3
        if not warm:
            here = min(np.arctan(nu) / (np.pi * dt), 0.5 / dt)
            gain, best = _Constraint.of(problem, loop, np.array([here])).best()
            if gain[0] * (1 + margin / 2) > level:
                found, freq_hz = float(gain[0]), float(here)
                level, nu, log_tau = found * (1 + margin), 0.0, None
                continue
            log_tau, _ = _calmest(scaling, response, best[0])
        assert log_tau is not None
        up, down = scaling.of(log_tau)
        reached = _holds_until(StateSpace(closed.A, closed.B * down, closed.C * up[:, None], closed.D * up[:, None] * down, 0.0), nu)
        if reached == np.inf:
            return RobustGain(level, found, freq_hz)
        if reached <= nu * (1 + 1e-9):
            if not warm:
                return None
            log_tau = None
        nu = reached
    return None


@dataclass(frozen=True, eq=False)
class _Scaling:
    """Factors of rows and columns; `rows` and `columns` hold the number of the perturbation, -1 for the performance."""

    rows: Array
    columns: Array
    level: float

    def of(self, log_tau: Array) -> tuple[Array, Array]:
        """Return the factors for some multipliers."""
        root = np.exp(log_tau / 2)
        return np.where(self.rows < 0, 1.0, root[self.rows]), np.where(self.columns < 0, 1 / self.level, 1 / root[self.columns])


def _calmest(scaling: _Scaling, response: Array, point: Array) -> tuple[Array, float]:
    """Multipliers that leave the most room below the level at one frequency, and the gain: compass search on a quasiconvex function."""

    def size(log_tau: Array) -> float:
        up, down = scaling.of(log_tau)
        return float(np.linalg.norm(response * up[:, None] * down, 2))

    value, step = size(point), 1.0
    while step > 1e-2:
        tried = [point + step * sign * direction for direction in np.eye(len(point)) for sign in (1, -1)]
        sizes = [size(x) for x in tried]
        k = int(np.argmin(sizes))
        if sizes[k] < value:
            point, value = tried[k], sizes[k]
        else:
            step /= 2
    return point, value


def _evened(system: StateSpace) -> StateSpace:
    """States in units of their own spread, for the sake of the eigenvalues."""
    size = np.sqrt(np.maximum(np.diag(gramian(system.A, system.B, system.dt)), 1e-300))
    size = np.where(size > 1e-12 * size.max(initial=0.0), size, 1.0)
    return StateSpace(system.A * size / size[:, None], system.B / size[:, None], system.C * size, system.D, system.dt)


def _holds_until(system: StateSpace, nu: float) -> float:
    """Largest mapped frequency up to which the gain stays below one from `nu` on; infinity when it does so for good."""
    points = np.unique(crossings(system, 1.0))
    points = np.concatenate([[nu], points[points > nu]])
    between = np.append((points[:-1] + points[1:]) / 2, max(points[-1], 1e-300) * 1e3)
    gains = np.linalg.norm(system.frequency_response(between / (2 * np.pi)), 2, axis=(-2, -1))
    above = np.flatnonzero(gains > 1)
    return float(points[above[0]]) if len(above) else np.inf
