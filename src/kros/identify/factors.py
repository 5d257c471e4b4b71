"""Triangular factors: each episode is reduced once, all least squares after that is algebra on small matrices.

The factor of an episode is R of the QR decomposition of ``[x g u v | x+ g+]``: states, parameter-free lifted functions,
inputs and parameter-free input functions at k, states and functions at k + 1. With delays the first k is the lifting's
history. Factors of several episodes combine by stacking and another QR (TSQR), so memory does not grow with the
recording and the condition number is never squared, as it is in (32)-(33).

Symbols
-------
x, u : states (n_samples, n) and inputs (n_samples, m)
g, v : parameter-free functions, sigma(w; q) = M(q) g(w) and gamma(u, w; q) = N(q) v(u, w) (see `lifting.Separation`)
R    : upper triangular factor, (n_columns, n_columns)

Everything is identified in channels divided by their ranges (`Ranges`), so that units of measure change nothing. With
the ranges of the lifted states and of the inputs as diagonal matrices X and U, ``z = X^-1 x``, ``A_z = X^-1 A X`` and
``B_z = X^-1 B U``. Only a regularisation, a threshold or a penalty sees the difference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..core import Array, ArrayLike, DataError, IdentificationError, Names, Whole, frozen
from ..core.linalg import qr_triangle
from ..data import EpisodeKey, Population
from ..data.recording import usable
from ..lifting import Lifting
from ..lifting.window import FormulaSeparation
from .edmd import KoopmanMatrices, edmd

Task = tuple[Population, Sequence[EpisodeKey], Lifting]  # episodes of one unit

_BLOCK_ROWS = 1024  # a block of this many rows stays in cache


@frozen
class Factor:
    """Reduced data of one or more episodes, or a batch of such reductions.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.identify import Factor, combine
    >>> rows = np.random.default_rng(0).normal(size=(3, 49, 2))  # three episodes of [x, u]
    >>> parts = Factor(np.linalg.qr(rows, mode="r"), np.abs(rows).max(axis=1), np.full(3, 49))
    >>> combine(parts).R.shape, int(combine(parts).n_samples)
    ((2, 2), 147)
    """

    R: Array  # (..., n_columns, n_columns)
    peak: Array  # (..., n + n_basis + m + n_input_basis), largest magnitude of every column at k
    n_samples: Whole  # (...)

    def __getitem__(self, rows: Any) -> Factor:
        """Return some factors of a batch."""
        return Factor(self.R[rows], self.peak[rows], self.n_samples[rows])

    @classmethod
    def stack(cls, factors: Sequence[Factor], join: Callable[..., Any] = np.stack) -> Factor:
        """Stack factors along a new first axis, or join them along the one that they have."""
        return cls(*(join([getattr(f, name) for f in factors]) for name in vars(factors[0])))


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def reduce_episode(x: Array, u: Array, lifting: Lifting) -> Factor:
    """Reduce one episode to its factor: states x (n_samples, n) and inputs u (n_samples, m)."""
    lifting.window.require(len(x), beyond=1)
    window = lifting.windows(x, u)
    x, u = x[lifting.history :], u[lifting.history :]
    g = lifting.separation.evaluate(window)
    v = lifting.input_separation.evaluate(window, u) if lifting.input_functions else u[:, :0]
    if wrong := [f for f, values in zip(lifting.separation.basis, g.T, strict=True) if not usable(values).all()]:
        raise DataError(f"{wrong[0]} is not finite, or huge; use functions that are moderate on all recordings.")
    now = np.concatenate([x.T, g.T, u.T, v.T])  # a signal a row: extremes and reflections run along memory
    data = np.concatenate([now[:, :-1], now[: x.shape[1] + g.shape[1], 1:]])
    return Factor(triangular(data.T), np.maximum(now.max(axis=1), -now.min(axis=1)), np.asarray(data.shape[1]))


def triangular(rows: Array) -> Array:
    """Return R of the QR decomposition of a tall matrix, by cache-sized blocks."""
    n_blocks, width = len(rows) // _BLOCK_ROWS, rows.shape[1]
    if n_blocks > 1:
        head = rows[: n_blocks * _BLOCK_ROWS].reshape(n_blocks, _BLOCK_ROWS, width)
        rows = np.concatenate([qr_triangle(head).reshape(-1, width), rows[n_blocks * _BLOCK_ROWS :]])
    R = qr_triangle(rows)
    return np.concatenate([R, np.zeros((width - len(R), width))]) if len(R) < width else R


def combine(factors: Factor) -> Factor:
    """Combine a batch of factors over its last batch axis, shape (..., episode, n, n) to (..., n, n).

    >>> rows = np.random.default_rng(0).normal(size=(3, 49, 2))  # three episodes of [x, u]
    >>> parts = Factor(np.linalg.qr(rows, mode="r"), np.abs(rows).max(axis=1), np.full(3, 49))
    >>> combine(parts).R.shape, int(combine(parts).n_samples)
    ((2, 2), 147)
    """
    *batch, episodes, width, _ = factors.R.shape
    stacked = factors.R.reshape(*batch, episodes * width, width)
    return Factor(qr_triangle(stacked), factors.peak.max(axis=-2), factors.n_samples.sum(axis=-1))


def reduce_episodes(task: Task) -> Factor:
    """Reduce every episode of a task to its factor, stacked on the first axis."""
    population, keys, lifting = task
    factors = []
    for key in keys:
        try:
            factors.append(reduce_episode(*population.read_parts(key), lifting))
        except DataError as error:
            raise DataError(f"Identifying from {key}: {error}") from error
    return Factor.stack(factors)


def unit_factors(population: Population, keys: Mapping[str, Sequence[EpisodeKey]], lifting: Lifting) -> Factor:
    """Return the factors of [Psi | Theta_plus] of units from their episodes, with a lifting without parameters.

    Examples
    --------
    >>> import kros
    >>> from kros.identify import edmd, unit_factors
    >>> from kros.lifting import Lifting
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=3, seconds=1.0, seed=3).simulate().population
    >>> factor = unit_factors(motors, {unit: motors.keys(unit) for unit in motors.unit_ids}, Lifting(motors.states))
    >>> edmd(factor.R, len(motors.states), alpha=1.0).A.shape
    (2, 3, 3)
    """
    units = [combine(reduce_episodes((population, episodes, lifting))) for episodes in keys.values()]
    return lifted_factor(Factor.stack(units), lifting, {}, lifting)


def lifted_factor(factor: Factor, lifting: Lifting, parameters: dict[str, Array], model: Lifting) -> Factor:
    """Turn parameter-free factors into factors of ``[Psi | Theta_plus]`` for a model's lifting, or the linear one."""
    now, wide = lifting.n_states + len(lifting.separation.basis), factor.peak.shape[-1]  # columns of x+ are behind
    peak, of_inputs = np.split(factor.peak, [now], axis=-1)
    theta, peak = _widened(peak, lifting.separation, parameters, bool(model.functions))
    inputs, of_inputs = _widened(of_inputs, lifting.input_separation, parameters, bool(model.input_functions))
    lifted = theta.shape[-1]
    width = lifted + inputs.shape[-1]
    change = np.zeros((*factor.R.shape[:-1], width + lifted))
    change[..., :now, :lifted] = change[..., wide:, width:] = theta
    change[..., now:wide, lifted:width] = inputs
    peak = np.concatenate([peak, of_inputs], axis=-1)
    return Factor(qr_triangle(factor.R @ change), peak, factor.n_samples)


def _widened(
    peak: Array, separation: FormulaSeparation, parameters: dict[str, Array], functions: bool
) -> tuple[Array, Array]:
    """Return columns of signals, and of functions if asked, in terms of signals and basis; and bounds of magnitudes."""
    n = peak.shape[-1] - len(separation.basis)
    M = separation.matrix(parameters) if functions else np.zeros((0, len(separation.basis)))
    change = np.zeros((*peak.shape, n + M.shape[-2]))
    change[..., range(n), range(n)] = 1.0
    change[..., n:, n:] = M.mT
    return change, np.concatenate([peak[..., :n], np.einsum("...ij,...j->...i", np.abs(M), peak[..., n:])], axis=-1)


def require_excitation(factor: Factor, inputs: Sequence[str], where: str) -> None:
    """Refuse recorded inputs that are zero in all training episodes of linear models."""
    peaks = factor.peak.max(axis=0)[-len(inputs) :]
    if resting := [name for name, peak in zip(inputs, peaks, strict=True) if peak == 0]:
        raise IdentificationError(f"Input {resting[0]!r} is zero in all training episodes ({where}); drop the channel.")


@frozen
class Ranges:
    """Ranges of a model's channels."""

    outputs: Array  # (n_lifted,)
    inputs: Array  # (m,)

    @classmethod
    def of(cls, factor: Factor, n_lifted: int, rows: Any = slice(None)) -> Ranges:
        """Return the largest magnitudes in the training of some units; one for a channel that is always zero."""
        peak = factor.peak[rows].max(axis=0)
        peak = np.where(peak > 0, peak, 1.0)
        return cls(peak[:n_lifted], peak[n_lifted:])

    def sizes(self, lifting: Lifting, recorded: Names) -> dict[str, float]:
        """Return the ranges by name: of states, lifted functions, recorded inputs and functions of these."""
        names = (*lifting.names, *recorded, *lifting.input_functions)
        return dict(zip(names, np.concatenate([self.outputs, self.inputs]).tolist(), strict=True))

    def normalise(self, models: KoopmanMatrices) -> KoopmanMatrices:
        """Return models of channels divided by the ranges, batched."""
        x, u = self.outputs, self.inputs
        return KoopmanMatrices(models.A * x / x[:, None], models.B * u / x[:, None])

    def restore(self, models: KoopmanMatrices) -> KoopmanMatrices:
        """Return models of the channels as recorded from those of channels divided by the ranges."""
        return Ranges(1 / self.outputs, 1 / self.inputs).normalise(models)

    def triangles(self, R: Array) -> Array:
        """Return factors of ``[Psi | Theta_plus]`` of channels divided by the ranges."""
        return R / np.concatenate([self.outputs, self.inputs, self.outputs])

    def edmd(self, R: Array, alpha: ArrayLike = 0.0) -> KoopmanMatrices:
        """Return EDMD models of recorded channels whose regularisation acts on channels divided by the ranges."""
        return self.restore(edmd(self.triangles(R), len(self.outputs), alpha))
