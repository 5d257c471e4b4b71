r"""Frames in which residuals are closest to diagonal: `A E_k B` with `A = U_L T_L`, `B = T_R U_R` and determinants of one.

T are constant and real, U are unit triangular with stable first-order lags,

    U_ij(z) = c_ij0 + sum_k c_ijk phi_k(z),   phi_k = t_k / (t_k + w),   w = (z - 1) / (z + 1),

below the diagonal on the left and above it on the right, so that inverses are stable too, of the same order, and no determinant depends on
frequency. In such a frame a diagonal cover `D_L, D_R` costs as much as the full cover `A^-1 D_L, D_R B^-1` that it stands for: its volume.
A constant frame follows residuals of one direction, a triangular one a direction that turns with frequency (for two signals: any stable one).

Sought are the T, c and diagonal covers x(f) with the smallest mean cost

    mean_f [ mean x_l + mean x_r + log s ],   log s ~ 1 / (2 q) log sum_k tr (M_k M_k^H)^q,   M_k = e^-x_l A E_k B e^-x_r

by a quasi-Newton method with q rising, as in `cover`. Directions in which residuals are more than 80 dB below the largest count
as that: residuals of one and the same direction would be covered by a set of no volume.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ..small_matrices import adjoint, entries_first, multiply, sigma_max_first

Array = npt.NDArray[Any]

FLOOR = 1e-4
LAGS = 2  # of every input of a triangular factor
_POINTS = 40
_SQUARINGS = (1, 3, 5)  # q = 2^s + 1 = 3, 9, 33
_ITERATIONS = 150
_PULL = 1e-3  # towards covers of equal entries: their scale is shared with T
_REACH = (20.0, 1e4, 1e4, 1e4, 1e4)  # of covers (nepers), T_L, T_R, c_L, c_R: no step of a line search overflows
_TOP = np.sqrt(10.0)  # largest t of a lag


@dataclass(frozen=True, eq=False)
class Frames:
    """Left and right frames of residuals.

    Parameters
    ----------
    left, right : StateSpace
        A and B: square, stable with stable inverses, of determinant plus or minus one at every frequency.
    cost : float, nepers
        Mean cost of the optimal diagonal cover in these frames.
    """

    left: StateSpace
    right: StateSpace
    cost: float

    def of(self, residuals: Array, freqs_hz: Array) -> Array:
        """Return `A E B`."""
        return np.asarray(self.left.frequency_response(freqs_hz) @ residuals @ self.right.frequency_response(freqs_hz))


def with_floor(E: Array) -> Array:
    """Return residuals of shape (unit, frequency, p', m') with further ones, 80 dB below the largest singular value, in every direction."""
    p, m = E.shape[2:]
    size = FLOOR * sigma_max_first(entries_first(E)).max(axis=0)
    ones = [np.roll(np.eye(p, m), shift, axis=0 if p > m else 1) for shift in range(0, max(p, m), min(p, m))]
    return np.concatenate([E, size[None, :, None, None] * np.array(ones)[:, None]])


def best_frames(E: Array, freqs_hz: Array, sample_period_s: float) -> list[Frames]:
    """Return the best frame with lags, the best constant one, and the one that changes nothing.

    Parameters
    ----------
    E : ndarray, shape (unit, frequency, p', m'), complex
    freqs_hz : ndarray, shape (frequency,), Hz
    sample_period_s : float, s
    """
    size = sigma_max_first(entries_first(E)).max(axis=0)
    some = np.flatnonzero((size > 0) & (freqs_hz > 0))
    some = some[np.unique(np.linspace(0, len(some) - 1, _POINTS).round().astype(int))]
    t = np.tan(np.minimum(np.pi * freqs_hz[some] * sample_period_s, np.pi / 2 * (1 - 1e-9)))
    knots = np.geomspace(t[0], min(t[-1], _TOP), LAGS + 2)[1:-1]
    scaled = entries_first(with_floor(E[:, some] / size[some, None, None]))
    search = _Search(scaled, 1j * t, knots, sample_period_s)
    offset = float(np.log(size[some]).mean())
    still = search.descend(search.start(), constant=False, lagged=False)
    turned = min((search.descend(start, constant=True, lagged=False) for start in search.turns(still)), key=lambda y: search.value(y))
    lagged = search.descend(turned, constant=True, lagged=True)
    return [search.frames(y, offset) for y in (lagged, turned, still)]


@dataclass(frozen=True, eq=False)
class _Search:
    """Residuals of size one, entries first (p', m', unit, frequency), and the axis `w = j tan(pi f dt)` with the knots t of the lags."""

    E: Array
    w: Array
    knots: Array
    dt: float

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows, columns and frequencies."""
        p, m, _, n = self.E.shape
        return p, m, n

    @property
    def phi(self) -> Array:
        """One, and the lags, shape (lag, frequency)."""
        return np.concatenate([np.ones((1, len(self.w))), self.knots[:, None] / (self.knots[:, None] + self.w)])

    def sizes(self) -> list[int]:
        """Numbers of unknowns: covers, T_L, T_R, c_L, c_R."""
        p, m, n = self.shape
        count = len(self.knots) + 1
        return [(p + m) * n, p * p, m * m, p * (p - 1) // 2 * count, m * (m - 1) // 2 * count]

    def start(self) -> Array:
        """Unknowns of no change."""
        p, m, _ = self.shape
        sizes = self.sizes()
        return np.concatenate([np.zeros(sizes[0]), np.eye(p).ravel(), np.eye(m).ravel(), np.zeros(sizes[3] + sizes[4])])

    def turns(self, y: Array) -> list[Array]:
        """Starts of a constant frame: none, and the mean principal directions."""
        sizes, other = self.sizes(), y.copy()
        E = self.E / np.maximum(sigma_max_first(self.E), 1e-12)
        rows = np.einsum("ijkf,ljkf->il", E, np.conj(E)).real
        columns = np.einsum("ijkf,ilkf->jl", np.conj(E), E).real
        other[: sizes[0]] = 0.0
        other[sizes[0] : sum(sizes[:3])] = np.concatenate([np.linalg.eigh(rows)[1].T.ravel(), np.linalg.eigh(columns)[1].ravel()])
        return [y, other]

    def parts(self, y: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Covers (entry, frequency), T_L, T_R, and the triangular factors (p', p', frequency) and (m', m', frequency)."""
        p, m, n = self.shape
        x, TL, TR, cl, cr = np.split(y, np.cumsum(self.sizes())[:-1])
        U, V = (np.repeat(np.eye(k, dtype=complex)[:, :, None], n, axis=2) for k in (p, m))
        U[np.tril_indices(p, -1)] = cl.reshape(-1, len(self.knots) + 1) @ self.phi
        V[np.triu_indices(m, 1)] = cr.reshape(-1, len(self.knots) + 1) @ self.phi
        return x.reshape(p + m, n), TL.reshape(p, p), TR.reshape(m, m), U, V

    def cost(self, y: Array, squarings: int) -> tuple[float, Array]:
        """Return the smoothed mean cost and its gradient."""
        p, m, n = self.shape
        x, TL, TR, U, V = self.parts(y)
        A, B = np.einsum("ijf,jk->ikf", U, TL), np.einsum("ij,jkf->ikf", TR, V)
        AE, EB = multiply(A[:, :, None], self.E), multiply(self.E, B[:, :, None])
        scale = np.exp(-x[:p])[:, None, None] * np.exp(-x[p:])[None, :, None]
        M = multiply(AE, B[:, :, None]) * scale
        top = sigma_max_first(M).max(axis=0)
        M = M / top
        wide = p <= m
        power = multiply(M, adjoint(M)) if wide else multiply(adjoint(M), M)
        for _ in range(squarings):
            power = multiply(power, power)
        Y = multiply(power, M) if wide else multiply(M, power)
        marginal = (Y * np.conj(M)).real.sum(axis=2)
        total = marginal.sum(axis=(0, 1))
        q = 2**squarings + 1
        cost = x[:p].mean(axis=0) + x[p:].mean(axis=0) + np.log(top) + np.log(total) / (2 * q)
        value = cost.mean() + _PULL / 2 * (x**2).sum() / n - np.linalg.slogdet(TL)[1] / p - np.linalg.slogdet(TR)[1] / m
        of_x = (np.concatenate([1 / p - marginal.sum(axis=1) / total, 1 / m - marginal.sum(axis=0) / total]) + _PULL * x) / n
        slope = np.conj(Y) * scale / (top * total) / n
        of_A, of_B = np.einsum("ijkf,ajkf->iaf", slope, EB), np.einsum("ijkf,ibkf->bjf", slope, AE)
        of_TL = np.einsum("ijf,iaf->ja", U, of_A).real - np.linalg.inv(TL).T / p
        of_TR = np.einsum("bjf,cjf->bc", of_B, V).real - np.linalg.inv(TR).T / m
        of_U, of_V = np.einsum("iaf,ca->icf", of_A, TL), np.einsum("bjf,bc->cjf", of_B, TR)
        of_c = [(of_U[np.tril_indices(p, -1)] @ self.phi.T).real, (of_V[np.triu_indices(m, 1)] @ self.phi.T).real]
        return float(value), np.concatenate([g.ravel() for g in (of_x, of_TL, of_TR, *of_c)])

    def descend(self, y: Array, *, constant: bool, lagged: bool) -> Array:
        """Minimise over the covers, and over the constant and the triangular factors where asked."""
        from scipy.optimize import minimize

        sizes = self.sizes()
        free = np.repeat([True, constant, constant, lagged, lagged], sizes)

        def part(z: Array, squarings: int) -> tuple[float, Array]:
            moved = y.copy()
            moved[free] = z
            value, gradient = self.cost(moved, squarings)
            return value, gradient[free]

        found, reach = y[free], np.repeat(_REACH, sizes)[free]
        options: dict[str, Any] = {"method": "L-BFGS-B", "bounds": np.transpose([-reach, reach]), "options": {"maxiter": _ITERATIONS}}
        for squarings in _SQUARINGS:
            found = minimize(part, found, args=(squarings,), jac=True, **options).x
        y = y.copy()
        y[free] = found
        return y

    def value(self, y: Array) -> float:
        """Return the cost without smoothing."""
        p, m, _ = self.shape
        x, TL, TR, U, V = self.parts(y)
        M = multiply(multiply(np.einsum("ijf,jk->ikf", U, TL)[:, :, None], self.E), np.einsum("ij,jkf->ikf", TR, V)[:, :, None])
        M = M * np.exp(-x[:p])[:, None, None] * np.exp(-x[p:])[None, :, None]
        cost = x[:p].mean(axis=0) + x[p:].mean(axis=0) + np.log(sigma_max_first(M).max(axis=0))
        return float(cost.mean() - np.linalg.slogdet(TL)[1] / p - np.linalg.slogdet(TR)[1] / m)

    def frames(self, y: Array, offset: float) -> Frames:
        """Return the frames as systems, with entries of equal size on average over frequency."""
        p, m, _ = self.shape
        x, TL, TR, _, _ = self.parts(y)
        cl, cr = (c.reshape(-1, len(self.knots) + 1) for c in np.split(y, np.cumsum(self.sizes())[2:-1])[1:])
        even_l, even_r = (np.exp(-(v - v.mean())) for v in (x[:p].mean(axis=1), x[p:].mean(axis=1)))
        lower, upper = np.tril_indices(p, -1), np.triu_indices(m, 1)
        U = unit_triangular(p, lower, cl * (even_l[lower[0]] / even_l[lower[1]])[:, None], self.knots, self.dt)
        V = unit_triangular(m, upper, cr * (even_r[upper[1]] / even_r[upper[0]])[:, None], self.knots, self.dt)
        TL, TR = even_l[:, None] * TL, TR * even_r
        TL, TR = (T / np.exp(np.linalg.slogdet(T)[1] / len(T)) for T in (TL, TR))
        left = StateSpace(U.A, U.B @ TL, U.C, U.D @ TL, self.dt)
        right = StateSpace(V.A, V.B, TR @ V.C, TR @ V.D, self.dt)
        return Frames(left, right, self.value(y) + offset)


def unit_triangular(size: int, places: tuple[Array, Array], coefficients: Array, knots: Array, sample_period_s: float) -> StateSpace:
    """Return the identity with `c_0 + sum_k c_k t_k / (t_k + w)` at some places beside the diagonal; lags of an input are shared.

    Parameters
    ----------
    size : int
    places : tuple of ndarray
        Rows and columns.
    coefficients : ndarray, shape (place, 1 + lag)
    knots : ndarray, shape (lag,)
    sample_period_s : float, s
    """
    used = np.unique(places[1]) if np.any(coefficients[:, 1:]) else np.zeros(0, int)
    count = len(knots)
    poles, through = (1 - knots) / (1 + knots), knots / (1 + knots)
    A = np.kron(np.eye(len(used)), np.diag(poles))
    B, C, D = np.zeros((len(A), size)), np.zeros((size, len(A))), np.eye(size)
    for block, column in enumerate(used):
        B[block * count : (block + 1) * count, column] = through * (1 + poles)
    for row, column, c in zip(*places, coefficients, strict=True):
        D[row, column] += c[0] + c[1:] @ through
        for block in np.flatnonzero(used == column).tolist():
            C[row, block * count : (block + 1) * count] = c[1:]
    return StateSpace(A, B, C, D, sample_period_s)
