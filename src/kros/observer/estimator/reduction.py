r"""Fewer states: balanced truncation of a bank with its readout, controllability taken from the recordings.

With L the root of the observability Gramian and P the recordings' second moment of the bank, the principal directions of :math:`L P L^T` carry the
squared singular values. The projection is orthogonal in the metric of the observability Gramian, in which A is a contraction, so that the result is
stable whatever P is (B. C. Moore, IEEE Trans. Autom. Control 26 (1981) 17-32; L. Pernebo and L. M. Silverman, ibid. 27 (1982) 382-387).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ...core.norms import gramian_root
from .regression import Readout

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Filters:
    """Filters with a readout: ``z+ = A z + B v``, estimate ``C z + D v``, started with ``z = S v`` at the first sample."""

    A: Array  # (r, r)
    B: Array  # (r, channels)
    C: Array  # (n, r)
    D: Array  # (n, channels)
    S: Array  # (r, channels)
    singular_values: Array  # all of them, relative to the errors of the estimates


def reduced(readout: Readout, errors: Array, order: int | None, loss: float) -> Filters:
    """Return the filters of a readout, reduced until errors (n,) of the estimates grow by a share, or to an order."""
    design = readout.design
    fine = replace(design, bank=design.bank.fine)
    A, B, S = fine.bank.system()
    weights = design.bank.refined(readout.coefficients).T
    X, w = fine.sample
    size = np.sqrt(w @ (X * X))
    size = np.where(size > 0, size, 1.0)
    A, B, S = A * size / size[:, None], B / size[:, None], S / size[:, None]
    C = weights * size @ A
    D = weights * size @ B
    used = np.isfinite(errors) & (errors > 0)
    errors = errors.copy()
    errors[list(design.channels.measured)] *= design.settings.measured_loss
    root = gramian_root(A.T, (C[used] / errors[used, None]).T, 1.0).T
    _, values, U = np.linalg.svd(root, full_matrices=False)
    kept = values > np.finfo(float).eps * values[0]
    L, inverse = values[kept, None] * U[kept], U[kept].T / values[kept]
    _, sigma, V = np.linalg.svd((X / size * np.sqrt(w)[:, None]) @ L.T, full_matrices=False)
    if order is None:
        left = np.append(np.cumsum((sigma**2)[::-1])[::-1], 0.0)
        order = int(np.argmax(left <= 2 * loss * used.sum()))
    V = V[: max(1, min(order, len(sigma)))]
    scale = np.maximum(sigma[: len(V)], np.finfo(float).eps * sigma[0])  # states of RMS one
    left_map, right_map = (V @ L) / scale[:, None], (inverse @ V.T) * scale
    return Filters(left_map @ A @ right_map, left_map @ B, C @ right_map, D, left_map @ S, sigma)
