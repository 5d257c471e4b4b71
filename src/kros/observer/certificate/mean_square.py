r"""Measurements that are lost at random, each sample independently of others: a gain in mean square, proven.

At a step theta says what arrives, with probability ``pi_theta``, independently of the past and of the disturbance at that step. If a ``P > 0`` satisfies

.. math:: \begin{bmatrix} P - C^T C & 0 \\ 0 & \gamma^2 I \end{bmatrix}
          - \sum_\theta \pi_\theta F_{\theta d}^T P F_{\theta d} \succ 0, \qquad F_{\theta d} = \begin{bmatrix} A_{\theta d} & B_{\theta d} \end{bmatrix}

for all slopes d, then ``E sum |z_k|^2 <= gamma^2 E sum |w_k|^2 + V(e_0)``: V decreases in the mean. Without disturbances and slopes that
is the second moment's own Lyapunov equation, and exact. Slopes are covered by multipliers; what a correction's limit or a prediction over a
delay adds depends on what arrived, and has a channel for every theta.

P solves a Riccati equation with a sum of closed loops, by Newton's method from below: linear equations of the second moment in coordinates in
which all states are equally reachable. What is returned was proven in exact arithmetic (`proof`).

References
----------
T. Morozan, "Stabilization of some stochastic discrete-time control systems", Stochastic Analysis and Applications 1 (1983) 89-116.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from ..data import ObserverData
from .certificate import ReliftCertificate
from .error import ErrorSystem, error_system
from .proof import proven
from .riccati import frequency_bound, reachable_coordinates

Array = npt.NDArray[np.float64]
_MOST_STATES = 40
_GAINS = (1.02, 1.1, 1.3, 2.0, 4.0, 16.0, 256.0)
_HEAVIER = (1.0, 3.0, 10.0)
_HALVINGS = 4
_NEWTON = 25
_EXTRA = 1e-7  # of what the inequality may miss, for the sake of a strict one


@dataclass(frozen=True)
class DropoutBound:
    """What is proven of an observer whose measurements are lost at random.

    Parameters
    ----------
    rate : float
        Largest probability with which a measurement is lost.
    gain : float or None
        In mean square, in the units of the certificate's sizes; None where nothing is proven.
    reason : str
        Why not.

    Examples
    --------
    >>> from kros.observer import DropoutBound
    >>> DropoutBound(rate=0.1, gain=3.2).gain
    3.2
    """

    rate: float
    gain: float | None
    reason: str = ""


def dropout_bound(certificate: ReliftCertificate, observer: ObserverData, rates: npt.ArrayLike) -> DropoutBound:
    """Bound the error of an observer in mean square where measurements are lost independently.

    Parameters
    ----------
    certificate : ReliftCertificate
        Of this observer: its sizes, box and parameters are taken.
    observer : ObserverData
        While a measurement is missing its innovation is zero; the filter runs on.
    rates : array_like, shape (q,) or ()
        Probability that a sample of a measurement is lost.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import gain
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer, dropout_bound, relift_certificate
    >>> from kros.synthesis import Injection
    >>> observer = Observer("x", Lifting(("x",)), np.array([[0.9]]), np.ones((1, 1)), (0,), ("u",), gain([[0.5]], 0.01), Injection.STATE, 0.01)
    >>> certificate = relift_certificate(observer)
    >>> certificate.gain < dropout_bound(certificate, observer, 0.1).gain
    True
    """
    rates = np.broadcast_to(np.asarray(rates, dtype=float), (len(observer.measured),))
    worst = float(rates.max(initial=0.0))
    if not certificate.certified:
        return DropoutBound(worst, None, "it has no certificate as it runs")
    options = (certificate.scales, certificate.box, certificate.parameters)
    modes = []
    for arrives in product((True, False), repeat=len(rates)):
        probability = float(np.prod(np.where(arrives, 1 - rates, rates)))
        if probability > 0:
            modes.append((probability, error_system(observer, *options, arrives=arrives)))
    if len(modes[0][1].A) > _MOST_STATES:
        return DropoutBound(worst, None, f"its error has {len(modes[0][1].A)} states, more than {_MOST_STATES}")
    gain = _least(modes)
    return DropoutBound(worst, gain, "" if gain is not None else _reason(modes))


def _reason(modes: Sequence[tuple[float, ErrorSystem]]) -> str:
    loops = [np.kron(system.A, system.A) * probability for probability, system in modes]
    radius = float(np.abs(np.linalg.eigvals(sum(loops))).max(initial=0.0))
    if radius >= 1:
        return f"the error grows by {np.sqrt(radius):.6g} a step in mean square, slopes in the middle"
    return "no Lyapunov function was found for losses at random and all slopes in the box"


def _least(modes: Sequence[tuple[float, ErrorSystem]]) -> float | None:
    """Return the least gain that is proven on a way up from the one without losses, and a few halvings down."""
    multipliers, least = frequency_bound(modes[0][1])
    if not np.isfinite(least):
        multipliers, least = np.ones(len(multipliers)), 1.0

    def holds(gain: float) -> bool:
        heavier = _HEAVIER if len(multipliers) else (1.0,)
        return any(_proven(modes, multipliers * factor * gain / least, gain) for factor in heavier)

    last = 1.0
    for factor in _GAINS:
        if holds(factor * least):
            break
        last = factor
    else:
        return None
    for _ in range(_HALVINGS):
        middle = float(np.sqrt(last * factor))
        last, factor = (last, middle) if holds(middle * least) else (middle, factor)
    return factor * least


def _proven(modes: Sequence[tuple[float, ErrorSystem]], multipliers: Array, gain: float) -> bool:
    """Whether a gain is proven with these multipliers."""
    A, B, C, D = _stacked(modes, multipliers, gain)
    R = _root(A, B, C, D, gain, modes[0][1])
    return R is not None and proven(R, [(A, B)], C, gain, D)


def _stacked(
    modes: Sequence[tuple[float, ErrorSystem]], multipliers: Array, gain: float
) -> tuple[Array, Array, Array, Array]:
    """Stack the steps of all modes, each times the root of its probability, and the outputs."""
    first = modes[0][1]
    n, width = len(first.A), first.L.shape[1]
    same = np.ones(width, dtype=bool)
    for _, system in modes[1:]:
        for name in ("M", "D", "nested"):
            same &= np.all(getattr(system, name) == getattr(first, name), axis=1)
    own = np.flatnonzero(~same)
    n_p = width + (len(modes) - 1) * len(own)
    place = [np.arange(width)]
    for i in range(1, len(modes)):
        at = np.arange(width)
        at[own] = width + (i - 1) * len(own) + np.arange(len(own))
        place.append(at)
    n_w, n_z = first.B.shape[1], len(first.C)
    A, B = np.zeros((len(modes) * n, n)), np.zeros((len(modes) * n, n_p + n_w))
    C, D = np.zeros((n_p + n_z, n)), np.zeros((n_p + n_z, n_p + n_w))
    for i, ((probability, system), at) in enumerate(zip(modes, place, strict=True)):
        size, rows = np.sqrt(probability), slice(i * n, (i + 1) * n)
        share = np.where(same, 1.0, probability)
        (step, moved), q, feed = system.multiplied(multipliers * share, gain)
        A[rows], B[rows, at], B[rows, n_p:] = size * step, size * moved[:, :width], size * moved[:, width:]
        C[at] = q[:width]
        D[np.ix_(at, at)], D[at, n_p:] = feed[:width, :width], feed[:width, width:]
    C[n_p:] = first.C
    return A, B, C, D


def _root(A: Array, B: Array, C: Array, D: Array, gain: float, arriving: ErrorSystem) -> Array | None:
    """Return the triangular factor of a Lyapunov matrix, or None where Newton's method leaves what is possible."""
    n, count = A.shape[1], len(A) // A.shape[1]
    steps, enters = A.reshape(count, n, n), B.reshape(count, n, -1) / gain
    D = D / gain
    T, back = reachable_coordinates(arriving.A, np.hstack([arriving.L, arriving.B]), arriving.dt)
    steps, enters, C = back @ steps @ T, back @ enters, C @ T
    extra = _EXTRA * np.eye(n)
    K, P = np.zeros((enters.shape[2], n)), np.zeros((n, n))
    for _ in range(_NEWTON):
        closed, out = steps + enters @ K, C + D @ K
        Q = out.T @ out - K.T @ K + extra
        moment = sum(np.kron(a.T, a.T) for a in closed)
        try:
            following = np.linalg.solve(np.eye(n * n) - moment, Q.ravel()).reshape(n, n)
        except np.linalg.LinAlgError:
            return None
        following = (following + following.T) / 2
        weighed = following @ enters
        inner = np.eye(enters.shape[2]) - D.T @ D - np.einsum("tij,tik->jk", enters, weighed)
        if (
            not np.isfinite(following).all()
            or np.linalg.eigvalsh(inner)[0] <= 0
            or np.linalg.eigvalsh(following)[0] <= 0
        ):
            return None
        K = np.linalg.solve(inner, np.einsum("tij,tik->jk", weighed, steps) + D.T @ C)
        done = np.abs(following - P).max() <= 1e-11 * np.abs(following).max()
        P = following
        if done:
            break
    return np.asarray(np.linalg.qr(np.linalg.cholesky(P).T @ back, mode="r"))
