"""Linear recursions of many signals."""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array
from .library import library


def recursion(F: Array, driven: Array, first: Array, G: Array | None = None) -> Array:
    """Return ``h[k + 1] = F h[k] + G driven[k]``, shape (n_samples, batch, n)."""
    (n_samples, batch, m), n = driven.shape, len(F)
    if not n:
        return np.zeros((n_samples, batch, 0))
    if (loops := library()) is not None:
        states, column = np.empty((n_samples, n, batch)), np.zeros((n + m, batch))
        column[:n] = first.T
        job = {
            "observers": 1,
            "samples": n_samples,
            "batch": batch,
            "map": np.hstack([F, np.eye(n) if G is None else G]),
            "u": driven.swapaxes(1, 2),
            "column": column,
        }
        linear = {"n": n, "m": m, "registers": n + m, "lifted": np.arange(n + m), "n_lifted": n, "n_inputs": m}
        loops.call("kros_relift", ("formulas", linear), ("relift_job", job | {"states": states}))
        return states.swapaxes(1, 2)
    h, own = np.empty((n_samples, batch, n)), np.ascontiguousarray(F.T)
    driven = driven if G is None else driven @ G.T
    h[0] = first
    for k in range(n_samples - 1):
        h[k + 1] = h[k] @ own + driven[k]
    return h
