"""Norms of systems: H2 by Lyapunov equations, H-infinity by level sets (never by a grid alone).

Everything that kros claims about a closed loop is recomputed here, by code that shares nothing with the solvers.

Symbols
-------
A, B, C, D : state-space matrices
P : controllability Gramian, shape (n, n)
H : Hamiltonian matrix of the bounded-real lemma at the level gamma, shape (2n, 2n)
nu : frequency after the bilinear map, z = (1 + j nu) / (1 - j nu), that is nu = tan(theta / 2)

References
----------
N. A. Bruinsma and M. Steinbuch, "A fast algorithm to compute the H-infinity norm of a transfer function matrix",
Systems & Control Letters 14 (1990) 287-293.
"""

from collections.abc import Callable
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np

from .arrays import AnyArray
from .errors import DimensionError, KrosError, SynthesisError
from .linalg import balanced_size, qr_triangle
from .lti import StateSpace
from .rounding import AGREED, EPS, ITERATED, TINY

_MAX_ITERATIONS = 60
_DIGITS, _MOST_STATES = (40, 80, 160), 60  # of multiple precision, where double does not suffice
_AGREE = 1e-7  # relative difference of what should be equal, beyond which double precision is not trusted


def as_state_space(system: Any) -> StateSpace:
    """Return one system as `StateSpace`; anything with `A, B, C, D, dt` will do."""
    system = StateSpace.of(system)
    if system.batch_shape:
        raise DimensionError(f"System norm: needs one system, found a batch of shape {system.batch_shape}; index it.")
    if not system.is_finite():
        raise KrosError("System norm: the matrices contain NaN or infinity; look at the step that built them.")
    return system


def gramian(A: AnyArray, B: AnyArray, dt: float) -> AnyArray:
    """Gramian of a stable pair, ``P = A P A' + B B'``, or ``A P + P A' + B B' = 0`` for ``dt = 0``."""
    from scipy.linalg import solve_continuous_lyapunov

    if dt == 0:
        return solve_continuous_lyapunov(A, -B @ B.T)
    root = gramian_root(A, B)
    return root @ root.T


def gramian_root(A: AnyArray, B: AnyArray) -> AnyArray:
    """Return R with ``R R'`` the controllability Gramian of a stable discrete pair, shape (n, at most n).

    ``P = sum_k A^k B B' A'^k`` is summed by doubling on its factor, ``R_2k`` is the triangle of
    ``[R_k, A^k R_k]``. Poles near one cost a few more doublings and no accuracy. R is not finite where the rounding of
    powers grows: the pair is too badly conditioned, as that of states which are multiples of one another.
    """
    power, R = A, qr_triangle(B.T).T
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_MAX_ITERATIONS):
            step = power @ R
            R = qr_triangle(np.hstack([R, step]).T).T
            if np.all(np.abs(step).max(axis=1, initial=0.0) <= EPS * np.abs(R).max(axis=1, initial=0.0)):
                break
            power = power @ power
    return R


def h2_norm(system: Any) -> float:
    r"""H2 norm (5): root mean square of the output under white noise of unit variance.

    .. math:: \|G\|_2^2 = \mathrm{tr}(C P C^T + D D^T)

    Parameters
    ----------
    system : StateSpace
        Or any object with `A, B, C, D, dt`.

    Returns
    -------
    float
        Infinity for an unstable system, and for a continuous one whose `D` is not zero.

    Examples
    --------
    >>> from kros.core import StateSpace, h2_norm
    >>> round(h2_norm(StateSpace([[0.6]], [[1.0]], [[0.8]], [[0.0]], 1.0)), 12)
    1.0
    """
    system = balanced(as_state_space(system))
    # Rounding, ``eps ||A||``, decides whether a pole of a balanced system is stable.
    beyond, rounding = system.largest_pole() - (system.dt > 0), 10 * EPS * np.linalg.norm(system.A)
    if beyond > rounding or (system.dt == 0 and np.any(system.D)):
        return float("inf")
    if beyond >= -rounding:
        return precise_h2_norm(system)
    squared = float(np.trace(system.C @ gramian(system.A, system.B, system.dt) @ system.C.T))
    dual = float(np.trace(system.B.T @ gramian(system.A.T, system.C.T, system.dt) @ system.B))
    if not abs(squared - dual) <= _AGREE * max(squared, dual):
        return precise_h2_norm(system)
    return float(np.sqrt(max(squared, 0.0) + (np.sum(system.D**2) if system.dt > 0 else 0.0)))


def balanced(system: StateSpace) -> StateSpace:
    """Return a system whose states are scaled by powers of two, so that rows and columns of A are of alike size."""
    size = balanced_size(system.A)
    return StateSpace(system.A * size / size[:, None], system.B / size[:, None], system.C * size, system.D, system.dt)


def hinf_norm(system: Any, tol: float = AGREED) -> float:
    r"""H-infinity norm (3)-(4): largest gain over all frequencies.

    The level :math:`\gamma` is attained exactly where the Hamiltonian matrix of the bounded-real lemma has eigenvalues
    on the imaginary axis. Starting from a lower bound (DC, Nyquist, the frequencies of all poles, a logarithmic grid),
    the gain is evaluated at and between those eigenvalues until no frequency exceeds :math:`(1 + \mathrm{tol})` times
    the bound. A resonance too narrow for any grid is found. Discrete systems go through the bilinear map, which keeps
    the norm.

    Parameters
    ----------
    system : StateSpace
        Or any object with `A, B, C, D, dt`.
    tol : float
        Relative width of the bracket; the value returned is attained, and the norm is at most ``(1 + tol)`` times
        larger.

    Returns
    -------
    float
        Infinity for an unstable system.

    Examples
    --------
    >>> from kros.core import StateSpace, hinf_norm
    >>> round(hinf_norm(StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 1.0)), 12)
    2.0
    """
    system = as_state_space(system)
    if tol <= 0:
        raise KrosError(f"H-infinity norm: tol should be positive, found {tol}.")
    if not system.is_stable():
        return float("inf")
    if not (system.n_states and system.D.size):
        return float(np.linalg.norm(system.D, 2)) if system.D.size else 0.0
    continuous = balanced(to_continuous(system) if system.dt > 0 else system)
    known = first_frequencies(continuous.poles())
    at, lower = max(_peak(system, known, False), (np.inf, float(np.linalg.norm(continuous.D, 2))), key=itemgetter(1))
    if lower == 0.0:
        return 0.0
    error = _rounding(system, at) / lower
    refined, room = error > tol, max(error, tol)  # eigenvalues are as inaccurate
    for _ in range(_MAX_ITERATIONS):
        points = crossings(continuous, lower * (1 + room))
        peak, best = _peak(system, np.append(known, points) if refined else points, refined)
        before, (at, lower) = lower, max((peak, best), (at, lower), key=itemgetter(1))
        if best <= before * (1 + room):
            return precise_gain(system, _in_hz(system, at)) if refined else lower
    raise KrosError(f"H-infinity norm: no convergence in {_MAX_ITERATIONS} level sets from {lower}; scale states.")


def to_continuous(system: StateSpace) -> StateSpace:
    """Map a discrete system to continuous time by ``z = (1 + s) / (1 - s)``, which keeps the gains."""
    n, eye = system.n_states, np.eye(system.n_states)
    A, B = np.split(np.linalg.solve(system.A + eye, np.hstack([system.A - eye, system.B])), [n], axis=1)
    C = np.linalg.solve((system.A + eye).T, system.C.T).T
    return StateSpace(A, np.sqrt(2) * B, np.sqrt(2) * C, system.D - system.C @ B, 0.0)


def _peak(system: StateSpace, nu: AnyArray, refined: bool) -> tuple[float, float]:
    """Return the mapped frequency of the largest gain and that gain, if asked searched for around it."""
    nu = np.unique(nu)
    gains = _gains(system, nu)
    if refined:
        return sharpened(partial(_gains, system), nu, gains)
    best = int(np.argmax(gains))
    return float(nu[best]), float(gains[best])


def sharpened(size: Callable[[AnyArray], AnyArray], points: AnyArray, values: AnyArray) -> tuple[float, float]:
    """Return place and height of the largest of values at increasing points, searched for between its neighbours."""
    from scipy.optimize import minimize_scalar

    top = int(np.argmax(values))
    ends = points[max(top - 1, 0)], points[min(top + 1, len(points) - 1)]
    options = {"xatol": ITERATED * ends[1]}
    best = minimize_scalar(lambda at: -size(np.array([at])).max(), bounds=ends, method="bounded", options=options)
    return max((float(best.x), float(-best.fun)), (float(points[top]), float(values[top])), key=itemgetter(1))


def _in_hz(system: StateSpace, nu: Any) -> Any:
    return np.arctan(nu) / (np.pi * system.dt) if system.dt > 0 else np.divide(nu, 2 * np.pi)


def _gains(system: StateSpace, nu: AnyArray) -> AnyArray:
    """Largest singular values at the mapped frequencies `nu` (rad/s for a continuous system)."""
    return np.linalg.norm(system.frequency_response(_in_hz(system, nu)), 2, axis=(-2, -1))


def _rounding(system: StateSpace, nu: float) -> float:
    """Bound of what rounding changes in the gain at one frequency: ``eps || |C R| (|z| I + |A|) |R B| ||``."""
    if np.isinf(nu) and system.dt == 0:
        return 0.0
    z = np.exp(2j * np.pi * _in_hz(system, nu) * system.dt) if system.dt > 0 else 1j * nu
    eye = np.eye(system.n_states)
    R = np.linalg.inv(z * eye - system.A)
    inside = np.abs(system.C @ R) @ (np.abs(z) * eye + np.abs(system.A)) @ np.abs(R @ system.B)
    return float(EPS * np.linalg.norm(inside, 2))


def first_frequencies(poles: AnyArray) -> AnyArray:
    """Frequencies for the first lower bound, rad/s: DC, all poles of a continuous system, a grid around them."""
    sizes = np.abs(poles)
    low, high = np.maximum([sizes.min(), sizes.max()], TINY)
    # A pole a + jb peaks at sqrt(b^2 - a^2) in the transfer function of second order.
    peaks = np.sqrt(np.maximum(poles.imag**2 - poles.real**2, 0.0))
    grid = np.geomspace(low / 10, 10 * high, 100)
    return np.unique(np.concatenate([[0.0], sizes, np.abs(poles.imag), peaks, grid]))


def crossings(system: StateSpace, gamma: float) -> AnyArray:
    """Frequencies at which a singular value may equal `gamma`, with the points between them."""
    A, B, C, D = system.matrices
    R = gamma**2 * np.eye(system.n_inputs) - D.T @ D
    F, n = np.linalg.solve(R, np.hstack([D.T @ C, B.T])), system.n_states
    closed = A + B @ F[:, :n]
    # gamma scales the two halves alike, which keeps the eigenvalues and balances the blocks.
    Q = C.T @ C + C.T @ D @ F[:, :n]
    H = np.block([[closed, gamma * (B @ F[:, n:])], [-Q / gamma, -closed.T]])
    eigenvalues = np.linalg.eigvals(H)
    axis = np.maximum(1e-3 * np.abs(eigenvalues), 100 * EPS * np.linalg.norm(H))
    near = eigenvalues[(np.abs(eigenvalues.real) <= axis) & (eigenvalues.imag >= 0)]
    points = np.unique(np.concatenate([[0.0], near.imag]))
    between = np.concatenate([(points[1:] + points[:-1]) / 2, np.sqrt(points[1:] * points[:-1])])
    return np.concatenate([points, between])


def precise_h2_norm(system: StateSpace) -> float:
    """H2 norm, infinite where a pole is not stable; digits double until two results agree."""
    import mpmath

    if system.n_states > _MOST_STATES:
        raise SynthesisError(f"H2 norm: {system.n_states} states are too many for more than double precision.")
    before = np.nan
    for digits in _DIGITS:
        with mpmath.workdps(digits):
            norm = _norm_of(mpmath, system)
        if norm == before or abs(norm - before) <= ITERATED * abs(norm):
            return norm
        before = norm
    raise SynthesisError(f"H2 norm: {_DIGITS[-1]} digits do not suffice; the system has poles on the stability limit.")


def _norm_of(mp: Any, system: StateSpace) -> float:
    """``tr(C P C' + D D')``, the Gramian P summed by doubling; infinite where powers of A do not vanish."""
    A, B, C, D = (mp.matrix(matrix.tolist()) for matrix in system.matrices)
    if system.dt == 0:  # the bilinear map keeps the Gramian
        inverse = mp.inverse(mp.eye(A.rows) - A)
        A, B = inverse * (mp.eye(A.rows) + A), mp.sqrt(2) * inverse * B
    P = B * B.T
    for _ in range(2 * mp.mp.dps):
        if mp.mnorm(A) <= mp.eps:
            square = C * P * C.T + D * D.T
            return float(mp.sqrt(sum(square[i, i] for i in range(C.rows))))
        P, A = P + A * P * A.T, A * A
    return float("inf")


def precise_gain(system: StateSpace, freq_hz: float) -> float:
    """Largest singular value at one frequency, the resolvent in multiple precision."""
    import mpmath

    with mpmath.workdps(_DIGITS[0]):
        s = mpmath.mpc(0, 2 * mpmath.pi * mpmath.mpf(freq_hz))
        point = mpmath.exp(s * mpmath.mpf(system.dt)) if system.dt > 0 else s
        A, B, C, D = (mpmath.matrix(matrix.tolist()) for matrix in system.matrices)
        response = C * mpmath.inverse(point * mpmath.eye(system.n_states) - A) * B + D
        return float(np.linalg.norm(np.array(response.tolist(), complex), 2))
