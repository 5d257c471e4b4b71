r"""Entrywise weights: every entry of the residual has a bound of its own, for a diagonal perturbation.

    E_ij = W_ij delta_ij,  |delta_ij| <= 1        E = L diag(delta_11, delta_12, ...) R

L picks rows, R holds the weights: entry (i, j) is the dyad of row `e_i` of L and `W_ij e_j^T` of R. The paper bounds residuals this way (its
Figure 8) and then puts `W Delta` with a full Delta into its generalized plant. For that set the bound does not hold: `|W_ij| >= |E_ij|` says
nothing about `sigma_max(W^-1 E)`, which `EntrywiseWeight.unstructured_excess` measures. With the diagonal Delta it holds, and mu analysis can use it.

Every entry is one scalar fit, tight to its own data and certified like all others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace, block_diagonal, gain
from .certificate import Method
from .check import Checks, Residuals
from .cover import Cover, Structure
from .pencils import ResidualSystems
from .weight import Weight, fit_weight

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class EntrywiseWeight(Weight):
    """Bounds of every entry, sound for a diagonal perturbation only.

    `left` (p' by p' m') picks rows and has no states, `right` (p' m' by m') holds the weights, entries row by row; ``left @ right`` is the
    matrix of weights. `cover_max` is the largest `|E_k,ij / W_ij|`, overbounds are those of entries, and orders are zero and those of the entries.

    Parameters
    ----------
    unstructured_excess : float
        Largest `sigma_max(W^-1 E_k)` over units and the dense grid: by how much residuals leave `W Delta` with a full perturbation. Infinite
        where W is singular, NaN where it is not square.
    """

    unstructured_excess: float = float("nan")

    def magnitudes(self, freqs_hz: npt.ArrayLike) -> Cover:
        """Return ones, and the magnitudes of the weights row by row, shape (frequency, p' m')."""
        rows = np.arange(self.right.n_outputs)
        values = np.abs(self.right.frequency_response(freqs_hz)[:, rows, rows % self.right.n_inputs])
        return Cover(np.ones_like(values), values)

    def matrix(self) -> StateSpace:
        """Return the matrix of weights, p' by m'; the bounds of the entries."""
        return self.left @ self.right


def fit_entrywise(
    residuals: Residuals, freqs_hz: Array, sample_period_s: float, *, systems: ResidualSystems | None = None, **options: Any
) -> tuple[EntrywiseWeight, Cover]:
    """Fit a weight to every entry of the residuals.

    Parameters
    ----------
    residuals, freqs_hz, sample_period_s, systems, **options
        As of `fit_weight`.

    Returns
    -------
    EntrywiseWeight
    Cover
        Ones, and the largest entries of the residuals row by row.
    """
    E = residuals(freqs_hz)
    p, m = E.shape[2:]
    fits = []
    for i, j in np.ndindex(p, m):
        of_entry = None if systems is None else replace(systems, entry=(i, j))
        part = slice(i, i + 1), slice(j, j + 1)
        fits.append(
            fit_weight(
                lambda f, part=part: residuals(f)[:, :, part[0], part[1]],  # type: ignore[misc]
                freqs_hz,
                sample_period_s,
                structure=Structure.SCALAR,
                systems=of_entry,
                **options,
            )[0]
        )
    left, right = dyads([fit.left for fit in fits], p, m, sample_period_s)
    sizes = np.abs(E).max(axis=0).reshape(len(freqs_hz), p * m)
    cover = Cover(np.ones_like(sizes), sizes)
    checks = Checks(options.get("density", 10), options.get("also_hz"), systems, options.get("sampled", False))
    dense = checks.claimed(freqs_hz, sample_period_s)
    weight = EntrywiseWeight(
        left=left,
        right=right,
        left_orders=(0,) * (p * m),
        right_orders=tuple(fit.left_orders[0] for fit in fits),
        structure=Structure.ENTRYWISE,
        cover_max=max(fit.cover_max for fit in fits),
        overbound_db_max=_mean_excess_db(fits, freqs_hz, sizes),
        within_tolerance=all(fit.within_tolerance for fit in fits),
        overbound_entry_db=max(fit.overbound_entry_db for fit in fits),
        method=Method.LEVEL_SETS if all(fit.method is Method.LEVEL_SETS for fit in fits) else Method.GRID,
        remaining_margin=min(fit.remaining_margin for fit in fits),
    )
    return replace(weight, unstructured_excess=unstructured_excess(weight.matrix(), residuals(dense), dense)), cover


def dyads(entries: list[StateSpace], p: int, m: int, sample_period_s: float) -> tuple[StateSpace, StateSpace]:
    """Return L and R of weights given row by row: `E = L diag(delta) R`."""
    rows, columns = np.kron(np.eye(p), np.ones((1, m))), np.tile(np.eye(m), (p, 1))
    return gain(rows, sample_period_s), block_diagonal(entries) @ gain(columns, sample_period_s)


def unstructured_excess(matrix: StateSpace, E: Array, freqs_hz: Array) -> float:
    """Return the largest `sigma_max(W^-1 E_k)`: one at most where W alone would cover a full perturbation.

    Parameters
    ----------
    matrix : StateSpace
    E : ndarray, shape (unit, frequency, p', m'), complex
    freqs_hz : ndarray, shape (frequency,), Hz
    """
    if matrix.n_outputs != matrix.n_inputs:
        return float("nan")
    some = np.abs(E).max(axis=(0, 2, 3)) > 0
    try:
        inverse = np.linalg.inv(matrix.frequency_response(freqs_hz[some]))
    except np.linalg.LinAlgError:
        return float("inf")
    return float(np.linalg.norm(inverse @ E[:, some], 2, axis=(-2, -1)).max(initial=0.0))


def _mean_excess_db(fits: list[Weight], freqs_hz: Array, sizes: Array) -> float:
    """Largest mean over the entries of fitted over needed magnitude, dB; entries count where there is something to be covered."""
    fitted = np.stack([fit.magnitudes(freqs_hz).left[:, 0] for fit in fits], axis=1)
    some = sizes.min(axis=1) > 0
    return float((20 * np.log10(fitted[some] / sizes[some])).mean(axis=1).max(initial=0.0))
