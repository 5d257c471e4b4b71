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


def blocks_along(
    F: Array, G: Array, H: Array, z: Array, rest: Array, held: Array, every: int = 1, *, states: bool = True
) -> Array:
    """Return the states of a model in blocks of two, ``h[k + 1] = F h[k] + G z[k]``, or its estimates ``H h[k]``."""
    (blocks, _, channels), (batch, samples) = G.shape, z.shape[1:]
    if (loops := library()) is not None:
        found = np.empty((2 * blocks, batch, -(-samples // every)) if states else (len(H), batch, samples))
        job = {
            "blocks": blocks,
            "channels": channels,
            "outputs": len(H),
            "samples": samples,
            "batch": batch,
            "every": every,
        }
        job |= {"F": F, "G": G, "H": H, "z": z, "rest": rest, "held": held, "h" if states else "sum": found}
        loops.call("kros_blocks", ("blocks_job", job))
        return found
    h = np.zeros((samples, blocks, 2, batch))
    driven = np.einsum("bdc,cek->kbde", G, z - rest[..., None])
    for k in range(samples - 1):
        h[k + 1] = F @ h[k] + driven[k]
    h += held
    return (
        h.reshape(samples, 2 * blocks, batch)[::every].transpose(1, 2, 0)
        if states
        else np.einsum("obd,kbde->oek", H, h)
    )


def lattice_along(reflections: Array, x: Array, every: int = 1) -> Array:
    """Return the states of normalised lattice sections in a row along signals, from rest: those of an orthonormal basis.

    A. H. Gray and J. D. Markel, "A normalized digital filter structure", IEEE Trans. Acoust., Speech, Signal Process. 23 (1975) 268-277.
    """
    # k1 and k2 of (k2 + k1 (1 + k2) q + q^2) / (1 + k1 (1 + k2) q + k2 q^2), q the delay; without k2 of (k1 + q) / (1 + k1 q)
    single = np.isnan(reflections[:, 1])
    if (loops := library()) is not None:
        held = np.empty((int(np.sum(2 - single)), len(x), -(-x.shape[1] // every)))
        job = {
            "sections": len(reflections),
            "states": len(held),
            "signals": len(x),
            "samples": x.shape[1],
            "every": every,
        }
        loops.call("kros_chain", ("chain_job", job | {"reflections": reflections, "x": x, "held": held}))
        return held
    A, B = lattice(reflections)
    return recursion(A, x.T[..., None], np.zeros((len(x), len(A))), B[:, None])[::every].transpose(2, 1, 0)


def lattice(reflections: Array) -> tuple[Array, Array]:
    """Return A and B of `lattice_along`'s states ``s+ = A s + B x``: the rows of [A, B] are orthonormal."""
    A, B, C, D = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
    for k1, k2 in reflections:
        c1 = np.sqrt(1 - k1**2)
        if np.isnan(k2):
            a, b, c, d = np.array([[-k1]]), np.array([c1]), np.array([c1]), k1
        else:
            c2 = np.sqrt(1 - k2**2)
            a, b = np.array([[-k1, -c1 * k2], [c1, -k1 * k2]]), np.array([c1 * c2, k1 * c2])
            c, d = np.array([0.0, c2]), k2
        A = np.block([[A, np.zeros((len(A), len(a)))], [np.outer(b, C), a]])
        B, C, D = np.concatenate([B, b * D]), np.concatenate([d * C, c]), d * D
    return A, B
