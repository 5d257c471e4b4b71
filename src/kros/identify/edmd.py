"""Extended dynamic mode decomposition with Tikhonov regularisation, (30)-(33), on triangular factors.

    min_U ||Theta_plus - U Psi||_F^2 + alpha ||U||_F^2,      U = [A B]

is solved by QR of ``[R; sqrt(alpha) I]``, with `alpha` added to the unnormalised Gram matrix as in the paper and in
pykoop.

Uncertainty of the estimate itself: models of resampled episodes, from what each episode was reduced to.

    per-episode factors --draw episodes--> weighted restacking --EDMD--> samples of (A, B)

Whole episodes are drawn, since samples of one episode depend on each other. Of E episodes E - 1 are drawn with
replacement and each counts E / (E - 1) times as often as it was drawn: drawing E of E would give (E - 1) / E of the
variance (Rao and Wu, J. Am. Stat. Assoc. 83, 1988). `alpha` and the calibrated parameters stay as they are; a bias that
all episodes share is not seen.

Symbols
-------
R11, R12 : blocks of the factor of [Psi | Theta_plus]
U        : Koopman matrix [A B], (n_lifted, n_lifted + m)
w : weights of the episodes, (unit, draw, episode)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core import EPS, TINY, AnyArray, Array, ArrayLike, DataError, IdentificationError, StateSpace, frozen
from ..core.linalg import qr_triangle, spectral_radius


@dataclass(frozen=True)
class AlphaSearch:
    """How one Tikhonov coefficient is searched for all models of a population."""

    per_decade: int = 10  # values, from where every model is stable downwards
    decades: int = 14  # below the largest squared singular value of the data, which double precision resolves
    bisections: int = 30  # between the last two values, which leave 1e-10 of the coefficient
    factor: float = 4.0  # how far alpha is above the smallest coefficient that stabilises every model, at least
    doublings: int = 12  # of the factor, at most, until the models of the units are alike
    largest_residual: float = 0.5  # peak up to which they are alike
    points: int = 60  # frequencies at which the models of the units are compared


@frozen
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

    def __getitem__(self, rows: Any) -> KoopmanMatrices:
        """Return some models of a batch."""
        return KoopmanMatrices(self.A[rows], self.B[rows])

    def spectral_radius(self) -> Array:
        """Return the largest eigenvalue magnitude of each A."""
        return spectral_radius(self.A)

    def responses(self, freqs_hz: Array, sample_period_s: float) -> AnyArray:
        """Return frequency responses from inputs to lifted states, shape (..., frequency, n, m)."""
        return self.systems(sample_period_s).frequency_response(freqs_hz)

    def systems(self, sample_period_s: float) -> StateSpace:
        """Return the systems from inputs to lifted states."""
        C = np.broadcast_to(np.eye(self.A.shape[-1]), self.A.shape)
        return StateSpace(self.A, self.B, C, np.zeros(self.B.shape), sample_period_s)


def edmd(R: Array, n_lifted: int, alpha: ArrayLike = 0.0) -> KoopmanMatrices:
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
    >>> model = edmd(np.linalg.qr(np.hstack([psi, after]), mode="r"), n_lifted=1)
    >>> model.A.round(6).tolist(), model.B.round(6).tolist()
    ([[0.9]], [[0.1]])
    """
    p = R.shape[-1] - n_lifted
    penalty = np.sqrt(alpha)[..., None, None] * np.eye(p, R.shape[-1])
    triangle = qr_triangle(np.concatenate(np.broadcast_arrays(R[..., :p, :], penalty), axis=-2))
    R11 = triangle[..., :p, :p]
    size = np.maximum(np.linalg.norm(R11, axis=-2), TINY)
    pivots = np.abs(np.linalg.diagonal(R11)) / size  # what is left of a column beside those before it
    if np.any(pivots < p * EPS):
        *unit, column = (int(i) for i in np.argwhere(pivots < p * EPS)[0])
        where = f" of unit number {unit[0]}" if unit else ""
        raise IdentificationError(
            f"EDMD: column {column} of the lifted data{where} depends on the others (relative pivot "
            f"{pivots.min():.1e}); remove the lifting function or input, excite it, or use alpha > 0."
        )
    U = np.swapaxes(np.linalg.solve(R11, triangle[..., :p, p:]), -1, -2)
    return KoopmanMatrices(U[..., :n_lifted], U[..., n_lifted:])


def smallest_stabilising_alpha(factors: list[tuple[Array, int]], margin: float = 0.0) -> float:
    """Return the infimum of the interval ``[alpha, inf)`` on which every model of every unit is stable.

    The stabilising set need not be an interval: the search goes down until a model is unstable, then bisects.

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
    search = AlphaSearch()
    largest = max(float(np.linalg.norm(R[..., : -n or None, : -n or None], axis=(-2, -1)).max()) for R, n in factors)
    top = 2 + np.ceil(np.log10(largest**2))
    grid = 10.0 ** np.arange(top, top - 2 - search.decades, -1 / search.per_decade)
    first = next((i for i, alpha in enumerate(grid) if not _all_stable(factors, alpha, margin)), None)
    if first is None:
        try:
            return 0.0 if _all_stable(factors, 0.0, margin) else float(grid[-1])
        except IdentificationError:  # a dependent column: some regularisation is needed, however small
            return float(grid[-1])
    if first == 0:
        raise IdentificationError(f"EDMD: models stay unstable up to alpha = {grid[0]:.1e}, with a margin of {margin}.")
    low, high = np.log10(grid[first]), np.log10(grid[first - 1])
    for _ in range(search.bisections):
        middle = (low + high) / 2
        if _all_stable(factors, 10**middle, margin):
            high = middle
        else:
            low = middle
    return float(10**high)


def _all_stable(factors: list[tuple[Array, int]], alpha: float, margin: float) -> bool:
    return all(bool((edmd(R, n, alpha).spectral_radius() < 1 - margin).all()) for R, n in factors)


@frozen
class ModelSamples:
    """Models of resampled episodes around an estimate."""

    estimate: KoopmanMatrices  # A (unit, n, n) and B (unit, n, m)
    samples: KoopmanMatrices  # A (unit, draw, n, n) and B (unit, draw, n, m)


def episode_weights(n_episodes: Sequence[int], draws: int, seed: int) -> Array:
    """Draw E - 1 of E episodes with replacement, and return how much each counts: (unit, draw, max(n_episodes))."""
    counts = list(n_episodes)
    if not counts or min(counts) < 2 or draws < 2:
        raise DataError(f"Resampling needs two episodes of every unit and two draws, found {counts} and {draws}.")
    weights = np.zeros((len(counts), draws, max(counts)))
    for row, E in enumerate(counts):
        rng = np.random.default_rng([seed, row])
        weights[row, :, :E] = rng.multinomial(E - 1, np.full(E, 1 / E), size=draws) * (E / (E - 1))
    return weights


def bootstrap_edmd(R: Array, n_lifted: int, alpha: float, weights: Array) -> ModelSamples:
    """Return EDMD models of resampled episodes at a fixed alpha, from factors (unit, episode, k, k) and weights."""
    units, episodes, width, _ = R.shape
    models = []
    for draw in [np.ones((units, episodes)), *np.swapaxes(weights, 0, 1)]:
        stacked = (np.sqrt(draw)[..., None, None] * R).reshape(units, episodes * width, width)
        models.append(edmd(qr_triangle(stacked), n_lifted, alpha))
    drawn = KoopmanMatrices(*(np.stack([getattr(m, name) for m in models[1:]], axis=1) for name in ("A", "B")))
    return ModelSamples(models[0], drawn)
