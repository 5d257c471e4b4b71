"""Order reduction of generalized plants, for the cost of matrix inequalities only: results are verified on the full plant.

Symbols
-------
P, Q : controllability and observability Gramians;  P = R R', Q = S' S;  S R = U diag(h) V', h the Hankel singular values
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.norms import gramian
from .generalized_plant import GeneralizedPlant

_NEGLIGIBLE = 1e-10


def truncate(plant: GeneralizedPlant, n_states: int) -> tuple[GeneralizedPlant, float]:
    """Balanced truncation of a stable plant from (w, u) to (z, y).

    Parameters
    ----------
    plant : GeneralizedPlant
        Stable; every signal should have a size near one, since all count alike.
    n_states : int
        At most; states whose Hankel singular value is negligible go in any case.

    Returns
    -------
    GeneralizedPlant
    float
        Sum of the discarded Hankel singular values over the largest one; twice their sum bounds the error in the H-infinity norm.
    """
    B, C = np.hstack([plant.B1, plant.B2]), np.vstack([plant.C1, plant.C2])
    R = _root(gramian(plant.A, B, plant.dt))
    S = _root(gramian(plant.A.T, C.T, plant.dt)).T
    U, h, Vh = np.linalg.svd(S @ R)
    k = min(n_states, int(np.sum(h > _NEGLIGIBLE * h[0])))
    left = (U[:, :k] / np.sqrt(h[:k])).T @ S
    right = R @ Vh[:k].T / np.sqrt(h[:k])
    small = replace(plant, A=left @ plant.A @ right, B1=left @ plant.B1, B2=left @ plant.B2, C1=plant.C1 @ right, C2=plant.C2 @ right)
    return small, float(h[k:].sum() / h[0])


def _root(matrix: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.maximum(values, 0.0))
