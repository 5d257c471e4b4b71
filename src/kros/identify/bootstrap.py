"""Uncertainty of the estimate itself: models of resampled episodes, from what each episode was reduced to.

    per-episode factors --draw episodes--> weighted restacking --EDMD--> samples of (A, B)
    per-episode normal equations of a finished refinement --draw episodes--> one Gauss-Newton step --> samples of (A, B)

Whole episodes are drawn, since samples of one episode depend on each other. Of E episodes E - 1 are drawn with
replacement and each counts E / (E - 1) times as often as it was drawn: drawing E of E would give (E - 1) / E of the
variance (Rao and Wu, J. Am. Stat. Assoc. 83, 1988). The prior, its centre, `alpha` and the calibrated parameters stay
as they are; a bias that all episodes share is not seen.

Symbols
-------
w : weights of the episodes, (unit, draw, episode)
N : ``[J r]^T [J r]`` of one episode, (P + 1, P + 1); H and g its blocks J^T J and J^T r
V : parameters, [A B] = V T^T
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from ..core.linalg import qr_triangle
from .edmd import KoopmanMatrices, edmd

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ModelSamples:
    """Models of resampled episodes around an estimate.

    Samples that are `linear` are first-order steps: they have the right spread, but what follows from them nonlinearly,
    such as a response or an eigenvalue, is to be taken to first order around the estimate as well (`responses` does).

    Examples
    --------
    >>> import numpy as np
    >>> from kros.identify import KoopmanMatrices, ModelSamples
    >>> estimate = KoopmanMatrices(np.full((1, 1, 1), 0.9), np.ones((1, 1, 1)))
    >>> draws = KoopmanMatrices(np.array([0.89, 0.9, 0.91]).reshape(1, 3, 1, 1), np.ones((1, 3, 1, 1)))
    >>> ModelSamples(("a",), estimate, draws).samples.A.std(axis=1, ddof=1).round(3).item()
    0.01
    """

    unit_ids: tuple[str, ...]
    estimate: KoopmanMatrices  # A (unit, n, n) and B (unit, n, m)
    samples: KoopmanMatrices  # A (unit, draw, n, n) and B (unit, draw, n, m)
    linear: bool = False

    def responses(self, row: int, freqs_hz: Array, sample_period_s: float) -> npt.NDArray[Any]:
        """Return frequency responses of one unit's samples, shape (draw, frequency, n, m).

        First-order samples have first-order deviations, ``dG = (zI - A)^-1 dW [G; I]``.
        """
        drawn = KoopmanMatrices(self.samples.A[row], self.samples.B[row])
        if not self.linear:
            return drawn.responses(freqs_hz, sample_period_s)
        A, B = self.estimate.A[row], self.estimate.B[row]
        G = KoopmanMatrices(A, B).responses(freqs_hz, sample_period_s)
        Phi = KoopmanMatrices(A, np.eye(len(A))).responses(freqs_hz, sample_period_s)
        return np.asarray(G + Phi @ ((drawn.A - A)[:, None] @ G + (drawn.B - B)[:, None]))


def episode_weights(n_episodes: Sequence[int], draws: int, seed: int) -> Array:
    """Draw episodes with replacement, E - 1 of E, and return how much each counts.

    The result has the shape (unit, draw, max(n_episodes)), zero where a unit has fewer episodes; each draw sums to the
    unit's number of episodes. A unit's draws depend on the seed and its row alone. With fewer than two episodes or
    draws a DataError is raised.

    Examples
    --------
    >>> from kros.identify import episode_weights
    >>> weights = episode_weights([4, 3], draws=100, seed=0)
    >>> weights.shape, weights.sum(axis=2).min(axis=1).tolist()
    ((2, 100, 4), [4.0, 3.0])
    """
    counts = [int(e) for e in n_episodes]
    if not counts or min(counts) < 2 or draws < 2:
        raise DataError(
            f"Resampling episodes: needs at least two episodes of every unit and two draws, found {counts} episodes of "
            f"the units and {draws} draws; record more, or leave the unit out."
        )
    weights = np.zeros((len(counts), draws, max(counts)))
    for row, E in enumerate(counts):
        rng = np.random.default_rng([seed, row])
        weights[row, :, :E] = rng.multinomial(E - 1, np.full(E, 1 / E), size=draws) * (E / (E - 1))
    return weights


def bootstrap_edmd(
    R: Array, n_lifted: int, alpha: float, weights: Array, unit_ids: Sequence[str] | None = None
) -> ModelSamples:
    """Return EDMD models of resampled episodes at a fixed alpha.

    Parameters
    ----------
    R : ndarray, shape (unit, episode, p + n_lifted, p + n_lifted)
        Factors of [Psi | Theta_plus] of every episode; zero where a unit has fewer episodes.
    n_lifted : int
    alpha : float
    weights : ndarray, shape (unit, draw, episode)
        See `episode_weights`.
    unit_ids : sequence of str, optional

    Raises
    ------
    IdentificationError
        When the episodes drawn leave a column dependent and `alpha` is zero.

    Examples
    --------
    >>> import kros
    >>> from kros.identify import bootstrap_edmd, episode_factors, episode_weights
    >>> from kros.lifting import Lifting
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=4, seconds=1.0, seed=3).simulate().population
    >>> keys = {unit: motors.keys(unit) for unit in motors.unit_ids}
    >>> factors = episode_factors(motors, keys, Lifting(motors.states))
    >>> samples = bootstrap_edmd(factors.R, 3, 1e-3, episode_weights([4, 4], draws=20, seed=0), motors.unit_ids)
    >>> samples.samples.A.shape
    (2, 20, 3, 3)
    """
    units, episodes, width, _ = R.shape
    models = []
    for draw in [np.ones((units, episodes)), *np.swapaxes(weights, 0, 1)]:
        stacked = (np.sqrt(draw)[..., None, None] * R).reshape(units, episodes * width, width)
        models.append(edmd(qr_triangle(stacked), n_lifted, alpha))
    drawn = KoopmanMatrices(*(np.stack([getattr(m, name) for m in models[1:]], axis=1) for name in ("A", "B")))
    ids = tuple(map(str, range(units) if unit_ids is None else unit_ids))
    return ModelSamples(ids, models[0], drawn)


def one_step_deviations(normal: Array, information: Array, weights: Array) -> Array:
    """Return where one Gauss-Newton step on resampled episodes leads from the estimate, shape (unit, draw, P)."""
    size = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), np.finfo(float).tiny))
    deviations = []
    for draw in np.swapaxes(weights, 0, 1):
        change = np.einsum("ue,ueij->uij", draw - 1, normal[:, :, :-1])  # (unit, P, P + 1)
        H = (information + change[..., :-1]) / (size[:, :, None] * size[:, None])
        deviations.append(_solve(H, change[..., -1] / size) / size)
    return np.stack(deviations, axis=1)


def bootstrap_refined(
    units: KoopmanMatrices, whitening: Array, information: Array, normal: Array, weights: Array, unit_ids: Sequence[str]
) -> ModelSamples:
    """Return refined models of resampled episodes, one Gauss-Newton step from the finished ones, `linear`.

    The prior keeps responses together along a curved set of (A, B), which a straight step leaves. Against full refits
    of three simulated drives, first-order bands were right to about 20 percent, bands of the steps' own responses 2.6
    to 12 times too wide.
    """
    n, p = units.A.shape[-1], len(whitening)
    dW = one_step_deviations(normal, information, weights).reshape(len(units.A), -1, n, p) @ whitening.T
    samples = KoopmanMatrices(units.A[:, None] + dW[..., :n], units.B[:, None] + dW[..., n:])
    return ModelSamples(tuple(unit_ids), units, samples, linear=True)


def _solve(H: Array, g: Array) -> Array:
    """Solve scaled normal equations, batched; directions that rounding alone determines do not move."""
    values, vectors = np.linalg.eigh((H + np.swapaxes(H, -1, -2)) / 2)
    known = values > 450 * np.finfo(float).eps * np.maximum(values[..., -1:], np.finfo(float).tiny)
    along = np.einsum("...ji,...j->...i", vectors, g)
    along = np.divide(along, values, out=np.zeros_like(along), where=known)
    return np.asarray(np.einsum("...ij,...j->...i", vectors, along))
