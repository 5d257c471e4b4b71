r"""Distance of models as the uncertainty of the population will count it: the prior, and the spread of a population.

In channels divided by their ranges E is the residual of the inverse input multiplicative form, with the pooled model G0
as nominal:

    E = G^+ (G - G0),      G = Phi B,  Phi = (zI - A)^-1,      dE = (G^+ Phi) dW Z (I - E),  Z = [G; I]
    cost = N strength level^2 mean over frequency of (e + e^2 / 2),      e = (||E||_F / level)^2

which is quadratic below `level`; the square of e flattens the residual's peak, which is what a weight has to cover.
`dE` neglects how the range of G turns, which is of second order.

Exact search for the candidate whose largest residual is smallest, without visiting all pairs.

A candidate's bound is the largest residual over the units, `b_c(f) = max_k sigma(E(c, k, f))`; any units and
frequencies that were looked at give a bound of `b_c` from below. The search evaluates the candidate with the lowest
such bound over *all* units, asks which unit was the worst at every frequency, and raises the lower bounds of all other
candidates by these witnesses. A candidate whose lower bound exceeds the best score so far is never evaluated; when none
is left below, the best is the best of all: nothing is assumed about the population. A population has few extreme units,
so that few rounds are needed; each visits as many pairs as there are units, not their square.
"""

from collections.abc import Callable

import numpy as np

from ...core import ITERATED, AnyArray, Array, frozen
from ...core.linalg import adjoint, entries_first, multiply, pieces, sigma_max_first

TIE = ITERATED  # relative; scores closer than rounding are one
_AT_ONCE = 10_000  # units times frequencies in a piece of a computation, which stays in a processor's cache


def smallest_largest(shape: tuple[int, int], size: Callable[[AnyArray, AnyArray], AnyArray]) -> tuple[int, AnyArray]:
    """Return the best of the units as candidates, and its bound; of a `shape` (unit, frequency).

    ``size(candidates, units)`` returns residuals, (row, frequency), for rows that broadcast to that: of a candidate and
    all units, (1, 1) and (row, 1), and of candidates and the witness of every frequency, (row, 1) and (1, frequency).
    """
    lower, exact, row, most = np.zeros(shape), np.full(shape[0], np.inf), 0, _AT_ONCE // shape[1]
    every = np.arange(shape[0])[:, None]
    while lower[row].max() <= exact.min() * (1 + TIE):
        residuals = np.concatenate([size(every[[row]], every[part]) for part in pieces(shape[0], most)])
        lower[row] = residuals.max(axis=0)
        exact[row] = lower[row].max()
        rows = np.flatnonzero(np.isinf(exact) & (lower.max(axis=1) <= exact.min() * (1 + TIE)))
        if not rows.size:
            break
        witness = residuals.argmax(axis=0)[None]
        of_witness = np.concatenate([size(every[rows[part]], witness) for part in pieces(len(rows), most)])
        lower[rows] = np.maximum(lower[rows], of_witness)
        row = int(rows[np.argmin(lower[rows].max(axis=1))])
    least = exact.min()
    index = int(np.argmax(exact <= least + TIE * np.abs(least)))  # the first of those that rounding may have told apart
    return index, lower[index]


def unit_circle(points: int) -> AnyArray:
    """Return ``exp(j omega)`` at logarithmic frequencies, six decades below Nyquist up to it."""
    return np.exp(1j * np.pi * np.logspace(-6, 0, points))


@frozen
class ResponsePrior:
    """Prior that keeps frequency responses near that of the pooled model."""

    A: Array  # (n, n)
    B: Array  # (n, m)
    T: Array  # (n + m, n + m)
    level: float
    weight: float = 1.0
    points: int = 100

    def residual(self, V: Array) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return E (unit, frequency, m, m) of models V, ``G^+ Phi`` and ``T^T Z (I - E)``."""
        W = V @ self.T.T
        n, m = self.B.shape
        z = unit_circle(self.points)
        shifted = z[:, None, None] * np.eye(n)
        Phi = np.linalg.inv(shifted - W[:, None, :, :n])
        G = Phi @ W[:, None, :, n:]
        G0 = np.linalg.solve(shifted - self.A, self.B + 0j * z[:, None, None])
        left = np.linalg.pinv(G)
        E = left @ (G - G0)
        Z = np.concatenate([G, np.broadcast_to(np.eye(m), (*G.shape[:2], m, m))], axis=-2)
        return E, left @ Phi, self.T.T @ Z @ (np.eye(m) - E)

    def normal(self, V: Array) -> Array:
        """Return ``[J r]^T [J r]`` with r = -E, weighted for the gradient of the cost; shape (unit, P + 1, P + 1)."""
        E, a, Z = self.residual(V)
        size = np.sum(np.abs(E) ** 2, axis=(-1, -2)) / self.level**2  # (unit, frequency)
        slope = self.weight * (1 + size) / size.shape[1]
        units, rows, columns = V.shape
        by_row = (adjoint(a) @ a) * slope[..., None, None]
        by_column = Z.conj() @ Z.mT
        flat = by_row.reshape(*size.shape, -1).transpose(0, 2, 1), by_column.reshape(*size.shape, -1)
        form = (flat[0] @ flat[1]).real.reshape(units, rows, rows, columns, columns)
        H = form.transpose(0, 1, 3, 2, 4).reshape(units, rows * columns, -1)
        pull = adjoint(a) @ (E * slope[..., None, None]) @ adjoint(Z)
        g = -pull.real.sum(axis=1).reshape(units, -1)
        cost = self.weight * self.level**2 * np.mean(size + size**2 / 2, axis=1)
        return np.block([[H, g[..., None]], [g[:, None], cost[:, None, None]]])


def peak_residual(A: Array, B: Array, points: int = 200) -> float:
    """Return the peak of ``G^+ (G_nominal - G)`` for the nominal unit that makes it smallest, channels over ranges."""
    if len(A) < 2:
        return float("nan")
    G = np.linalg.solve(unit_circle(points)[:, None, None] * np.eye(A.shape[-1]) - A[:, None], B[:, None] + 0j)
    inverse, G, every = entries_first(np.linalg.pinv(G)), entries_first(G), np.arange(points)  # (m, n, unit, frequency)

    def size(nominal: AnyArray, unit: AnyArray) -> AnyArray:
        return sigma_max_first(multiply(inverse[:, :, unit, every], G[:, :, nominal, every] - G[:, :, unit, every]))

    return float(smallest_largest((len(A), points), size)[1].max())
