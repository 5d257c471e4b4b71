"""Extended dynamic mode decomposition with Tikhonov regularisation, (30)-(33), on triangular factors.

    min_U ||Theta_plus - U Psi||_F^2 + alpha ||U||_F^2,      U = [A B]

is solved by QR of ``[R; sqrt(alpha) I]``, with `alpha` added to the unnormalised Gram matrix as in the paper and in pykoop.

Symbols
-------
R11, R12 : blocks of the factor of [Psi | Theta_plus]
U        : Koopman matrix [A B], (n_lifted, n_lifted + m)
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import IdentificationError
from ..core.linalg import qr_triangle
from ..core.lti import StateSpace

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]

_PER_DECADE = 10
_DECADES_BELOW = 14
_BISECTIONS = 30
_MODELS = 20_000  # in memory at once


@dataclass(frozen=True, eq=False)
class KoopmanMatrices:
    """Koopman matrices of a batch of units, A (..., n, n) and B (..., n, m).

    Examples
    --------
    >>> import numpy as np
    >>> from kros.identify import KoopmanMatrices
    >>> KoopmanMatrices(np.array([[0.9, 1.0], [0.0, 0.5]]), np.ones((2, 1))).spectral_radius().item()
    0.9
    """

    A: Array
    B: Array

    def spectral_radius(self) -> Array:
        """Return the largest eigenvalue magnitude of each A."""
        return np.abs(np.linalg.eigvals(self.A)).max(axis=-1)

    def responses(self, freqs_hz: Array, sample_period_s: float) -> npt.NDArray[Any]:
        """Return frequency responses from inputs to lifted states, shape (..., frequency, n, m)."""
        n, m = self.B.shape[-2:]
        C, D = (np.broadcast_to(M, (*self.A.shape[:-2], *M.shape)) for M in (np.eye(n), np.zeros((n, m))))
        return StateSpace(self.A, self.B, C, D, sample_period_s).frequency_response(freqs_hz)


def edmd(R: Array, n_lifted: int, alpha: npt.ArrayLike = 0.0) -> KoopmanMatrices:
    """Solve the regularised least-squares problem from factors.

    Parameters
    ----------
    R : ndarray, shape (..., p + n_lifted, p + n_lifted)
        Factors of [Psi | Theta_plus], with p = n_lifted + m.
    n_lifted : int
    alpha : array_like
        Tikhonov coefficients that broadcast against the batch.

    Returns
    -------
    KoopmanMatrices

    Raises
    ------
    IdentificationError
        When a column of Psi depends on the others and `alpha` is zero.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.identify import edmd
    >>> rng = np.random.default_rng(0)
    >>> psi = rng.normal(size=(40, 2))  # the state and the input
    >>> after = psi @ [[0.9], [0.1]]
    >>> found = edmd(np.linalg.qr(np.hstack([psi, after]), mode="r"), n_lifted=1)
    >>> found.A.round(6).tolist(), found.B.round(6).tolist()
    ([[0.9]], [[0.1]])
    """
    p = R.shape[-1] - n_lifted
    alpha = np.asarray(alpha, dtype=float)
    batch = np.broadcast_shapes(R.shape[:-2], alpha.shape)
    ridge = np.sqrt(alpha)[..., None, None] * np.eye(p)
    top = np.broadcast_to(R[..., :p, :], (*batch, p, R.shape[-1]))
    bottom = np.concatenate([np.broadcast_to(ridge, (*batch, p, p)), np.zeros((*batch, p, n_lifted))], axis=-1)
    triangle = qr_triangle(np.concatenate([top, bottom], axis=-2))
    R11, R12 = triangle[..., :p, :p], triangle[..., :p, p:]
    pivots = np.abs(np.diagonal(R11, axis1=-2, axis2=-1)) / np.maximum(
        np.linalg.norm(R11, axis=-2), np.finfo(float).tiny
    )
    if np.any(pivots < p * np.finfo(float).eps):
        *unit, column = (int(i) for i in np.argwhere(pivots < p * np.finfo(float).eps)[0])
        raise IdentificationError(
            f"EDMD: column {column} of the lifted data{f' of unit number {unit[0]}' if unit else ''} depends on the others (relative pivot "
            f"{pivots.min():.1e}); remove the lifting function or input, excite it, or use alpha > 0."
        )
    U = np.swapaxes(np.linalg.solve(R11, R12), -1, -2)
    return KoopmanMatrices(U[..., :n_lifted], U[..., n_lifted:])


def residual_covariance(R: Array, n_lifted: int, matrices: KoopmanMatrices, n_samples: npt.ArrayLike) -> Array:
    """Return the covariance of the one-step residual of given models, shape (..., n_lifted, n_lifted)."""
    p = R.shape[-1] - n_lifted
    U = np.concatenate([matrices.A, matrices.B], axis=-1)
    rest = R[..., :, p:] - R[..., :, :p] @ np.swapaxes(U, -1, -2)
    return np.swapaxes(rest, -1, -2) @ rest / np.asarray(n_samples, dtype=float)[..., None, None]


def smallest_stabilising_alpha(factors: list[tuple[Array, int]], margin: float = 0.0) -> float:
    """Find the infimum of the interval ``[alpha, inf)`` on which every model of every unit is stable.

    The stabilising set need not be an interval, so the search comes down from above: ten values per decade until a model is
    unstable, then bisection between the last two.

    Parameters
    ----------
    factors : list of (R, n_lifted)
        One batch of factors over units for every kind of model that has to share `alpha`.
    margin : float
        Stable means a spectral radius below ``1 - margin``.

    Returns
    -------
    float
        Zero where no regularisation is needed.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.identify import edmd, smallest_stabilising_alpha
    >>> R = np.array([[[1.0, 1.02]]])  # least squares alone gives a pole of 1.02
    >>> alpha = smallest_stabilising_alpha([(np.pad(R, ((0, 0), (0, 1), (0, 0))), 1)])
    >>> round(alpha, 3)
    0.02
    """
    ridges = [_Ridge.of(R, n) for R, n in factors]
    top = 2 + np.ceil(
        np.log10(
            max(float(np.linalg.norm(R[..., : -n or None, : -n or None], axis=(-2, -1)).max()) ** 2 for R, n in factors)
        )
    )
    grid = 10.0 ** np.arange(top, top - 2 - _DECADES_BELOW, -1 / _PER_DECADE)
    at_once = max(1, min(_PER_DECADE, _MODELS // max(len(R) for R, _ in factors)))
    for start in range(0, len(grid), at_once):
        unstable = [ridge.unstable(grid[start : start + at_once], margin) for ridge in ridges]
        found = np.any([own.any(axis=1) for own in unstable], axis=0)
        if found.any():
            break
    else:
        return 0.0 if _stable_without(factors, margin) else float(grid[-1])
    first = int(np.argmax(found))
    if start + first == 0:
        raise IdentificationError(
            f"EDMD: models stay unstable up to alpha = {grid[0]:.1e} with a stability margin of {margin}."
        )
    low, high = np.log10(grid[start + first]), np.log10(grid[start + first - 1])
    suspects = [ridge.take(own[first]) for ridge, own in zip(ridges, unstable, strict=True)]
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        if not _any_unstable(suspects, middle, margin):  # the others are asked where these say nothing
            if not _any_unstable(ridges, middle, margin):
                high = middle
                continue
            suspects = [ridge.take(ridge.unstable(np.array([10**middle]), margin)[0]) for ridge in ridges]
        low = middle
    return float(10**high)


@dataclass(frozen=True, eq=False)
class _Ridge:
    """Regularised models as functions of alpha: with ``R11 = P diag(s) Q^T``, ``A^T = Q1 diag(s / (s^2 + alpha)) P^T R12``."""

    left: Array  # (unit, n_lifted, p)
    values: Array  # (unit, p)
    right: Array  # (unit, p, n_lifted)

    @classmethod
    def of(cls, R: Array, n_lifted: int) -> _Ridge:
        p = R.shape[-1] - n_lifted
        P, values, Q = np.linalg.svd(R[:, :p, :p])
        return cls(
            np.ascontiguousarray(np.swapaxes(Q, 1, 2)[:, :n_lifted]), values, np.swapaxes(P, 1, 2) @ R[:, :p, p:]
        )

    def take(self, rows: npt.NDArray[np.bool_]) -> _Ridge:
        """Return those of some units."""
        return _Ridge(self.left[rows], self.values[rows], self.right[rows])

    def unstable(self, alphas: Array, margin: float) -> npt.NDArray[np.bool_]:
        """Tell which models are not stable, shape (alpha, unit)."""
        shrunk = self.values / np.maximum(self.values**2 + alphas[:, None, None], np.finfo(float).tiny)
        radius = np.abs(np.linalg.eigvals((self.left * shrunk[..., None, :]) @ self.right)).max(axis=-1, initial=0.0)
        return np.asarray(~(radius < 1 - margin))


def _any_unstable(ridges: list[_Ridge], exponent: float, margin: float) -> bool:
    return any(bool(ridge.unstable(np.array([10**exponent]), margin).any()) for ridge in ridges)


def _stable_without(factors: list[tuple[Array, int]], margin: float) -> bool:
    try:
        return all(bool(np.all(edmd(R, n).spectral_radius() < 1 - margin)) for R, n in factors)
    except IdentificationError:  # a dependent column: some regularisation is needed, however small
        log.info("some lifted data are rank deficient, so alpha = 0 is not an option")
        return False
