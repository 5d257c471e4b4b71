r"""Structured singular value: how large a structured perturbation must be before the loop becomes singular, from both sides.

.. math:: \mu(M) = 1 / \min\{\bar\sigma(\Delta) : \det(I - M\Delta) = 0\}

::

        +-----------+
     +->|  Delta_1  |--+
     |  |    ...    |  |  w
   z |  |  Delta_k  |  |
     |  +-----------+  |
     |    +-------+    |
     +----|   M   |<---+
          +-------+

The upper bound (`mu_scalings`) is what robustness rests on, the lower bound shows a perturbation and so how much of the upper one is real.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError, SynthesisError
from ...core.frequency import log_grid
from ...core.lti import StateSpace
from ...core.norms import as_state_space
from ..riccati.hinf_pointwise import resonances
from .between import everywhere
from .blocks import Block, Structure
from .power import power_iteration
from .scalings import scalings

Array = npt.NDArray[Any]

_POINTS = 200
_REFINEMENTS = 12
_PEAKS = 2
_FLAT = 1e-4


@dataclass(frozen=True, eq=False)
class MuBounds:
    """Bounds of the structured singular value over frequency.

    Parameters
    ----------
    freqs_hz : ndarray, shape (f,), Hz
        The grid asked for and the points that were added around the peaks.
    upper, lower : ndarray, shape (f,)
    peak : float
        Largest upper bound on the grid; perturbations smaller than ``1 / peak`` in norm cannot make the loop singular at these frequencies.
    peak_lower : float
        Largest lower bound: some perturbation of norm ``1 / peak_lower`` does.
    peak_hz : float, Hz
        Where the upper bound peaks.
    perturbation : ndarray, shape (w, z), complex
        Of norm one, at the frequency of `peak_lower`: ``det(I - M Delta / peak_lower e^{j phi}) = 0`` for some phi.
    everywhere : float or None
        Upper bound at every frequency, between the points too (`kros.synthesis.structured.between`): perturbations smaller than ``1 / everywhere``
        cannot make the loop singular at all. Usually one percent above `peak`. None where it was not asked for.

    Examples
    --------
    >>> from kros.core import StateSpace
    >>> from kros.synthesis import Block, mu_bounds
    >>> bounds = mu_bounds(StateSpace([[0.5]], [[0.4]], [[1.0]], [[0.0]], 0.01), [Block.full(1)])
    >>> round(bounds.peak, 3), bounds.everywhere >= bounds.peak
    (0.8, True)
    """

    freqs_hz: Array
    upper: Array
    lower: Array
    peak: float
    peak_lower: float
    peak_hz: float
    perturbation: Array
    everywhere: float | None = None


def mu_upper(M: npt.ArrayLike, blocks: Sequence[Block]) -> Array:
    """Return upper bounds of the structured singular value.

    Parameters
    ----------
    M : array_like, shape (..., z, w)
        Matrices, for example a frequency response.
    blocks : sequence of Block
        Structure of ``w = Delta z``.

    Returns
    -------
    ndarray, shape (...)
        The bound with optimal scalings; it equals the structured singular value for up to three full blocks.

    Raises
    ------
    DimensionError
        When the blocks do not fit the matrix.

    Examples
    --------
    >>> from kros.synthesis import Block, mu_upper
    >>> round(float(mu_upper([[2, 2], [-1, -1]], [Block.scalar(), Block.scalar()])), 6)
    3.0
    """
    matrices, structure = _checked(M, blocks)
    flat = matrices.reshape(-1, *matrices.shape[-2:])
    return np.asarray(scalings(flat, structure).upper.reshape(matrices.shape[:-2]))


def mu_lower(M: npt.ArrayLike, blocks: Sequence[Block]) -> tuple[Array, Array]:
    """Return lower bounds of the structured singular value, and perturbations of norm one that attain them.

    Parameters
    ----------
    M : array_like, shape (..., z, w)
    blocks : sequence of Block

    Returns
    -------
    ndarray, shape (...)
    ndarray, shape (..., w, z)

    Examples
    --------
    >>> from kros.synthesis import Block, mu_lower
    >>> bound, perturbation = mu_lower([[2, 2], [-1, -1]], [Block.scalar(), Block.scalar()])
    >>> round(float(bound), 6), perturbation.shape
    (3.0, (2, 2))
    """
    matrices, structure = _checked(M, blocks)
    value, Delta = power_iteration(matrices.reshape(-1, *matrices.shape[-2:]), structure)
    return value.reshape(matrices.shape[:-2]), Delta.reshape(*matrices.shape[:-2], *Delta.shape[-2:])


def mu_bounds(system: StateSpace, blocks: Sequence[Block], freqs_hz: npt.ArrayLike | None = None, *, prove: bool = True) -> MuBounds:
    """Return bounds of the structured singular value of a stable system over frequency.

    Parameters
    ----------
    system : StateSpace
        From w to z, stable.
    blocks : sequence of Block
    freqs_hz : array_like, shape (f,), Hz, optional
        Grid to start from, at least three points; the frequencies of lightly damped poles between them join it, and around the highest peaks points
        are added until the peak is located. By default 200 logarithmic points over six decades below Nyquist, or around the poles in continuous time.
    prove : bool
        Bound mu between the points as well. It costs an eigenvalue problem of twice the order for every range of frequencies that shares its scalings.

    Returns
    -------
    MuBounds

    Raises
    ------
    DimensionError
        When the blocks do not fit the system.
    SynthesisError
        When the system is unstable: then no perturbation is needed.

    Examples
    --------
    >>> from kros.core import StateSpace
    >>> from kros.synthesis import Block, mu_bounds
    >>> lag = StateSpace([[0.5]], [[0.4]], [[1.0]], [[0.0]], 0.01)  # its gain is largest at zero frequency: 0.4 / (1 - 0.5)
    >>> round(mu_bounds(lag, [Block.full(1)]).peak, 3)
    0.8
    """
    system = as_state_space(system)
    structure = Structure.of(blocks, system.D.shape)
    if not system.is_stable():
        raise SynthesisError("Structured singular value: the system is unstable as it is; stabilise it first.")
    freqs = _default_grid(system) if freqs_hz is None else np.unique(np.asarray(freqs_hz, dtype=float))
    if freqs.size < 3:
        raise DimensionError(f"Structured singular value: needs at least three frequencies, found {freqs.size}.")
    freqs = np.union1d(freqs, _peaks(system, freqs[0], freqs[-1]))
    freqs, upper = _located(system, structure, freqs, scalings(system.frequency_response(freqs), structure).upper)
    bound = None
    if prove:
        found = everywhere(system, structure, freqs, upper)
        bound = found.bound
        if found.upper.max(initial=0.0) > upper.max() * (1 + _FLAT):
            freqs, upper = _located(system, structure, *_merged(freqs, upper, found.freqs_hz, found.upper))
            bound = max(bound, float(upper.max()))
    lower, Delta = power_iteration(system.frequency_response(freqs), structure)
    top, low = int(np.argmax(upper)), int(np.argmax(lower))
    return MuBounds(freqs, upper, lower, float(upper[top]), float(lower[low]), float(freqs[top]), Delta[low], bound)


def _located(system: StateSpace, structure: Structure, freqs: Array, upper: Array) -> tuple[Array, Array]:
    """Add points around the highest peaks until these are located."""
    for _ in range(_REFINEMENTS):
        extra = _between(freqs, upper)
        if not extra.size:
            break
        freqs, upper = _merged(freqs, upper, extra, scalings(system.frequency_response(extra), structure).upper)
    return freqs, upper


def _merged(freqs: Array, upper: Array, more: Array, their: Array) -> tuple[Array, Array]:
    joined, first = np.unique(np.concatenate([freqs, more]), return_index=True)
    return joined, np.concatenate([upper, their])[first]


def _peaks(system: StateSpace, low_hz: float, high_hz: float) -> Array:
    """Frequencies of lightly damped poles within the grid, Hz."""
    found = resonances(system.A, system.dt > 0) / (2 * np.pi * (system.dt or 1.0))
    return found[(found > low_hz) & (found < high_hz)]


def _between(freqs: Array, upper: Array) -> Array:
    """Points on both sides of the highest local maxima."""
    padded = np.concatenate([[-np.inf], upper, [-np.inf]])
    peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    lowest = np.minimum(padded[peaks], padded[peaks + 2])
    lowest = np.where(np.isfinite(lowest), lowest, np.maximum(padded[peaks], padded[peaks + 2]))
    peaks = peaks[lowest < upper[peaks] * (1 - _FLAT)]  # others are resolved
    peaks = peaks[np.argsort(-upper[peaks])][:_PEAKS]
    left, right = peaks[peaks > 0], peaks[peaks < len(freqs) - 1]
    gaps = np.concatenate([np.stack([freqs[left - 1], freqs[left]]), np.stack([freqs[right], freqs[right + 1]])], axis=1)
    inner = gaps[0] + (gaps[1] - gaps[0]) * np.array([[1 / 3], [2 / 3]])
    return np.unique(inner[:, gaps[1] - gaps[0] > 1e-13 * gaps[1]])


def _default_grid(system: StateSpace) -> Array:
    if system.dt > 0:
        return log_grid(system.dt, _POINTS)
    sizes = np.abs(system.poles())
    return np.geomspace(max(sizes.min(initial=1.0), 1e-12) / 30, 30 * sizes.max(initial=1.0), _POINTS) / (2 * np.pi)


def _checked(M: npt.ArrayLike, blocks: Sequence[Block]) -> tuple[Array, Structure]:
    matrices = np.asarray(M, dtype=complex)
    if matrices.ndim < 2 or not np.isfinite(matrices).all():
        raise DimensionError(f"Structured singular value: needs finite matrices, shape (..., z, w), found shape {matrices.shape}.")
    return matrices, Structure.of(blocks, matrices.shape)
