"""Linear recursions of many signals."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .library import library, linear_formulas

Array = npt.NDArray[np.float64]


def filtered(x: Array, rest: Array, a1: float, a2: float, every: int = 1) -> tuple[Array, Array]:
    """Return ``held[k] = x[k - 1] - a1 held[k - 1] - a2 held[k - 2]`` at every so many samples, and one sample before these."""
    kept = -(-x.shape[-1] // every)
    if (loops := library()) is not None:
        now, before = (np.empty((*x.shape[:-1], kept)) for _ in range(2))
        job = {"signals": rest.size, "samples": x.shape[-1], "every": every, "poles": (a1, a2)}
        loops.call("kros_filter", ("filter_job", job | {"x": x, "rest": rest, "now": now, "before": before}))
        return now, before
    from scipy.signal import lfilter

    at_rest = (rest / (1.0 + a1 + a2))[..., None]
    moved = (
        np.asarray(lfilter([1.0], [1.0, a1, a2], (x - rest[..., None])[..., :-1])) + at_rest
    )  # x[k] has no part in held[k], whatever it is
    held = np.concatenate([at_rest, moved], axis=-1)[..., : x.shape[-1]]
    return held[..., ::every], np.concatenate([at_rest, held[..., every - 1 : -1 : every]], axis=-1)[..., :kept]


def all_pole(x: Array, a1: float, a2: float = 0.0) -> Array:
    """Return ``y[k] = x[k] - a1 y[k - 1] - a2 y[k - 2]`` from rest, shape (..., n_samples); SciPy's filters take a second to load."""
    ahead = np.concatenate([x, np.zeros((*x.shape[:-1], 1))], axis=-1)
    return filtered(ahead, np.zeros(x.shape[:-1]), a1, a2)[0][..., 1:]


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
        loops.call("kros_relift", linear_formulas(n, m), ("relift_job", job | {"states": states}))
        return states.swapaxes(1, 2)
    h, own = np.empty((n_samples, batch, n)), np.ascontiguousarray(F.T)
    driven = driven if G is None else driven @ G.T
    h[0] = first
    for k in range(n_samples - 1):
        h[k + 1] = h[k] @ own + driven[k]
    return h
