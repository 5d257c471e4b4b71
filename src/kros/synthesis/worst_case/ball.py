r"""The uncertain set per frequency: a matrix ball, its worst element and its average.

Derivation. With ``N = W_R W_L`` and ``||N|| < 1``, let ``X = Delta (I - N Delta)^-1``, so that ``Delta = (I + X N)^-1
X`` and

    ||Delta|| <= 1  <=>  X^H X <= (I + N X)^H (I + N X)  <=>  X^H Q X - X^H N^H - N X <= I,     Q = I - N^H N > 0.

Completing the square with ``X_c = Q^-1 N^H = N^H (I - N N^H)^-1`` gives ``(X - X_c)^H Q (X - X_c) <= I + N Q^-1 N^H =
(I - N N^H)^-1``:

    { Delta (I - N Delta)^-1 : ||Delta|| <= 1 } = { X_c + R_l Theta R_r : ||Theta|| <= 1 },
    R_l = (I - N^H N)^(-1/2),   R_r = (I - N N^H)^(-1/2).

*Upper bound.* `dual_bound`. Where the ball is around zero, von Neumann's trace inequality gives the maximum itself,
``||P Theta Q||_F^2 = tr(P^H P  Theta Q Q^H Theta^H) <= sum_i s_i(P)^2 s_i(Q)^2`` (`spread`).

Without a loop (``N = 0``) the set is the unit ball itself and the bound is attained; the same formulas hold whatever N
is made of, for example ``W_R G W_L``.

*Lower bound.* The worst case is at least any average over the set. Theta uniform on the matrices (b, a) with
orthonormal columns or rows has
mean zero and ``E[Theta Q Q^H Theta^H] = I ||Q||_F^2 / max(a, b)``, so for every T

    max_X ||T X M||_F^2 >= tr T (X_c M M^H X_c^H + R_l R_l^H ||R_r M||_F^2 / max(a, b)) T^H.

If N and M are diagonal the set of ``X M`` does not change under ``X -> V X V^H`` with V a diagonal matrix of signs, and
without a loop not under ``X -> V X``; averaging over V removes the off-diagonal entries of ``X M M^H X^H``. So in both
cases *the diagonal of the spectrum of any element* gives a lower bound as well, and because the observer's error is
linear in the spectrum, so does every convex combination of such spectra. Elsewhere the largest diagonal spectrum below
the average's is used.

Symbols
-------
N : (f, a, b) over f frequencies, with Delta and X (f, b, a);  M : (f, a, m);  T : error per unit of w2, shape (f, p, b)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.linalg import adjoint
from ..problem.observer_problem import ObserverProblem
from .dual_bound import dual_bound

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Ball:
    """The set ``{X_c + R_l Theta R_r}`` over frequency, with the right factor M already multiplied in."""

    center: Array  # shape (f, b, m); ``X_c M``
    left: Array  # shape (f, b, b); ``R_l``
    right: Array  # shape (f, a, m); ``R_r M``

    @classmethod
    def of(cls, N: Array, M: Array) -> Ball:
        """Build the ball of ``Delta (I - N Delta)^-1 M`` from N, shape (f, a, b), and M, shape (f, a, m)."""
        U, s, Vh = np.linalg.svd(N)
        k = s.shape[-1]
        radius = 1 / np.sqrt(1 - s**2)
        X_c = (adjoint(Vh)[..., :k] * (s * radius**2)[..., None, :]) @ adjoint(U)[..., :k, :]
        return cls(X_c @ M, _with_gains(adjoint(Vh), radius), _with_gains(U, radius) @ M)

    @classmethod
    def without_loop(cls, M: Array, b: int) -> Ball:
        """Build the ball of ``Delta M`` for Delta with b rows."""
        f, _, m = M.shape
        return cls(np.zeros((f, b, m), complex), np.broadcast_to(np.eye(b, dtype=complex), (f, b, b)), M)

    def bound(self, T: Array, certain: Array | float = 0.0) -> Array:
        """Upper bound of ``||certain + T X M||_F`` over the set, shape (f,); `certain` is (f, p, m).

        The root of the H2 density that no member exceeds.
        """
        return dual_bound(certain + T @ self.center, T @ self.left, self.right)

    def average(self) -> Array:
        """Average spectrum, shape (f, b, b)."""
        energy = np.sum(np.abs(self.right) ** 2, axis=(-2, -1)) / max(self.right.shape[-2], self.left.shape[-1])
        return self.center @ adjoint(self.center) + energy[..., None, None] * (self.left @ adjoint(self.left))

    def spectrum(self, theta: Array) -> Array:
        """Diagonal of the spectrum of the element of a contraction (f, b, a), shape (f, b)."""
        return np.sum(np.abs(self.center + self.left @ theta @ self.right) ** 2, axis=-1)

    def worst(self, T: Array, certain: Array | float = 0.0, iterations: int = 15) -> Array:
        """Contraction of an element that is (locally) worst for ``certain + T X M``, shape (f, b, a)."""
        P = T @ self.left
        _, _, Vh_p = np.linalg.svd(P)
        U_q, _, _ = np.linalg.svd(self.right)
        k = min(P.shape[-1], self.right.shape[-2])
        starts = (
            polar(adjoint(self.left) @ self.center @ adjoint(self.right)),  # aligned with the centre
            polar(
                adjoint(P) @ (certain + T @ self.center) @ adjoint(self.right)
            ),  # aligned with the centre, as T sees it
            adjoint(Vh_p)[..., :k] @ adjoint(U_q)[..., :k, :],  # worst without the centre
        )
        best, best_value = starts[0], np.full(T.shape[:-2], -1.0)
        for theta in starts:
            for k in range(iterations + 1):
                error = certain + T @ (self.center + self.left @ theta @ self.right)
                if k in (0, iterations):
                    value = np.linalg.norm(error, axis=(-2, -1))
                    better = value > best_value * (1 + 1e-6)
                    best, best_value = (
                        np.where(better[..., None, None], theta, best),
                        np.where(better, value, best_value),
                    )
                theta = polar(adjoint(P) @ error @ adjoint(self.right))
        return best


def uncertain_ball(problem: ObserverProblem, freqs_hz: Array) -> Ball:
    """Return the ball of ``Delta (I - N Delta)^-1 M`` of a problem at frequencies."""
    N = None if problem.N is None else problem.N.frequency_response(freqs_hz)
    return ball_of(N, problem.M.frequency_response(freqs_hz), problem.W_L.n_inputs)


def ball_of(N: Array | None, M: Array, b: int) -> Ball:
    """Return the ball of ``Delta (I - N Delta)^-1 M`` for Delta with b rows; N is None where there is no loop."""
    return Ball.without_loop(M, b) if N is None else Ball.of(N, M)


def spread(P: Array, Q: Array) -> Array:
    """Largest ``||P Theta Q||_F`` over contractions, ``(sum_i s_i(P)^2 s_i(Q)^2)^(1/2)``, shape (f,)."""
    s, t = np.linalg.svd(P, compute_uv=False), np.linalg.svd(Q, compute_uv=False)
    k = min(s.shape[-1], t.shape[-1])
    return np.sqrt(np.sum((s[..., :k] * t[..., :k]) ** 2, axis=-1))


def _with_gains(U: Array, gains: Array) -> Array:
    """Return ``U diag(gains, 1, ...) U^H``."""
    gains = np.concatenate([gains, np.ones((*gains.shape[:-1], U.shape[-1] - gains.shape[-1]))], axis=-1)
    return (U * gains[..., None, :]) @ adjoint(U)


def below(spectrum: Array) -> Array:
    """Return a diagonal spectrum below a full one, proportional to its diagonal: shape (f, b) for (f, b, b)."""
    power = np.real(np.einsum("fii->fi", spectrum))
    root = np.sqrt(np.maximum(power, 1e-300))
    least = np.linalg.eigvalsh(spectrum / (root[:, :, None] * root[:, None, :]))[:, 0]
    return power * np.clip(least, 0.0, 1.0)[:, None]


def polar(matrix: Array) -> Array:
    """Return the unitary polar factors, shape (f, a, b)."""
    U, _, Vh = np.linalg.svd(matrix, full_matrices=False)
    return U @ Vh
