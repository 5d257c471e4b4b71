r"""Matrices that no response of a system exceeds throughout a band of frequencies: what turns energies of signals into bounds of errors.

For a row t(z) of a stable system, and bands of the unit circle, a matrix is looked for with

.. math:: M_b \succeq t(z)^H t(z) \quad\text{for all } z \text{ in band } b, \qquad \mathrm{tr}(M_b W_b) \text{ small},

W_b the energies that it is for. Bands are covered by arcs. In the middle of arc s the response is ``t_s``, and no entry is further from it on the arc than
``delta_i`` (`Enclosure.entries`). The least matrix above all ``t_s^H t_s`` has the dual ``max tr(sum_s mu_s t_s^H t_s)^{1/2}`` over weights mu that sum to one,
which a multiplicative iteration solves; it is enlarged until it covers. For the rest, with any sizes s_i > 0,

.. math:: d^H d \preceq \Big(\sum_i \delta_i s_i\Big) \mathrm{diag}(\delta_i / s_i) \quad (|d_i| \le \delta_i), \qquad
          (t + d)^H (t + d) \preceq (1 + \epsilon)\, t^H t + (1 + 1/\epsilon)\, d^H d .

Arcs are halved until the rest is a hundredth of the whole. Nothing is decided at points: what lies between them is in delta.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.linalg import adjoint
from ...core.lti import StateSpace
from ...synthesis.worst_case.arcs import Enclosure

Array = npt.NDArray[Any]
_CLOSE = 0.01  # of a row's size in its band, or of its mean size over all of them
_ARCS = 20000
_ROUNDS = 30
_FIRST = 4  # arcs of a band in the beginning
_SHAPED = 48  # responses of a band that the shape of a matrix is made for
_ITERATIONS = 40
_RIDGE = 1e-10
_TINY = np.finfo(float).tiny
_SAFE = 1 + 1e-9  # for rounding of small matrices


def majorants(system: StateSpace, edges: Array, weight: Array, close: float = _CLOSE) -> Array:
    """Return matrices above the responses of every row of a system in every band, shape (p, b, m, m).

    Parameters
    ----------
    system : StateSpace
        Stable, p outputs and m inputs.
    edges : ndarray, shape (b + 1,), rad per sample
        From zero to pi.
    weight : ndarray, shape (b, m, m)
        Energies that the matrices are for; they hold for all.
    close : float
        How far the response may be from those in the middle of arcs, relative to its size.
    """
    size = np.sqrt(np.maximum(np.einsum("bii->i", weight).real, 0.0))
    size = np.where(size > 1e-100, size, 1.0)  # a channel without energy
    scaled = StateSpace(system.A, system.B * size, system.C, system.D * size, system.dt)
    W = weight / np.outer(size, size)
    W = W + _RIDGE * np.maximum(np.einsum("bii->b", W).real, _TINY)[:, None, None] * np.eye(len(size))
    values, vectors = np.linalg.eigh(W)
    root = (vectors * np.sqrt(values)[:, None, :]) @ adjoint(vectors)
    back = (vectors / np.sqrt(values)[:, None, :]) @ adjoint(vectors)
    sizes = np.sqrt(np.einsum("bii->bi", W).real)
    band, T, reach = _arcs(scaled, edges, root, sizes, close)

    n_bands, (p, m) = len(edges) - 1, T.shape[1:]
    t = T @ root[band]
    far = np.stack([reach[band == b].max(axis=0) for b in range(n_bands)])
    shape = _least_above(np.stack([_some(t[band == b]) for b in range(n_bands)]))
    inverse = np.linalg.inv(shape)
    height = np.einsum("kpi,kpij,kpj->kp", t, inverse[band], t.conj(), optimize=True).real
    most = np.stack([height[band == b].max(axis=0) for b in range(n_bands)])
    middle = back[:, None] @ (shape * (most * _SAFE)[..., None, None]) @ back[:, None]
    spread = np.einsum("bpi,bi->bp", far, sizes)
    rest = np.zeros((n_bands, p, m, m))
    rest[..., range(m), range(m)] = spread[..., None] * far / sizes[:, None]
    part = np.sqrt(np.einsum("bpii->bp", shape).real * most)
    epsilon = (np.maximum(spread, 1e-12 * part) + _TINY) / (part + _TINY)
    found = (1 + epsilon)[..., None, None] * middle + (1 + 1 / epsilon)[..., None, None] * rest
    found = (found + adjoint(found)) / 2 / np.outer(size, size)
    return np.asarray(np.swapaxes(found, 0, 1))


def energy(matrices: Array, energies: Array) -> Array:
    """Return ``sum_b tr(M_b Phi_b)`` for matrices (p, b, m, m) and energies (..., b, m, m), shape (..., p)."""
    return np.asarray(np.einsum("pbij,...bji->...p", matrices, energies, optimize=True).real)


def _arcs(system: StateSpace, edges: Array, root: Array, sizes: Array, close: float) -> tuple[Array, Array, Array]:
    """Return the band of every arc, the responses in the middle, (k, p, m), and the distances of entries on the arc, (k, p, m)."""
    enclosed, n_bands = Enclosure(system), len(edges) - 1
    cuts = edges[:-1, None] + np.diff(edges)[:, None] * np.linspace(0, 1, _FIRST + 1)
    theta, half = ((cuts[:, 1:] + cuts[:, :-1]) / 2).ravel(), (np.diff(cuts) / 2 * _SAFE).ravel()
    band = np.repeat(np.arange(n_bands), _FIRST)
    done: list[tuple[Array, Array, Array]] = []
    peak, tried = np.zeros((n_bands, system.n_outputs)), len(theta)
    for remaining in reversed(range(_ROUNDS)):
        T, reach = enclosed.entries(theta, half)
        np.maximum.at(peak, band, np.sum(np.abs(T @ root[band]) ** 2, axis=-1))
        allowed = close * np.sqrt(np.maximum(peak, peak.mean(axis=0)))
        loose = (np.einsum("kpi,ki->kp", reach, sizes[band]) > allowed[band]).any(axis=1)
        tried += 2 * int(loose.sum())
        if not remaining or tried > _ARCS:
            loose[:] = ~np.isfinite(reach).all(axis=(1, 2)) & bool(remaining)
        done.append((band[~loose], T[~loose], reach[~loose]))
        if not loose.any():
            break
        quarter = half[loose] / 2
        theta, half = np.concatenate([theta[loose] - quarter, theta[loose] + quarter]), np.concatenate([quarter, quarter])
        band = np.concatenate([band[loose], band[loose]])
    return tuple(np.concatenate(parts) for parts in zip(*done, strict=True))  # type: ignore[return-value]


def _some(rows: Array) -> Array:
    """Return as many responses for every band, evenly spread, shape (_SHAPED, p, m)."""
    return np.asarray(rows[np.linspace(0, len(rows) - 1, _SHAPED).round().astype(int)])


def _least_above(rows: Array) -> Array:
    """Return the shape of the matrix of least trace above the squares of rows, (b, s, p, m); shape (b, p, m, m), to be scaled."""
    rows = np.ascontiguousarray(np.swapaxes(rows, 1, 2))  # (b, p, s, m)
    columns, count, m = adjoint(rows), *rows.shape[2:]
    mu = np.full(rows.shape[:3], 1 / count)
    ridge = (_RIDGE * np.sum(np.abs(rows) ** 2, axis=(2, 3)) + _TINY)[..., None, None] * np.eye(m)
    for _ in range(_ITERATIONS):
        values, vectors = np.linalg.eigh((columns * mu[..., None, :]) @ rows + ridge)
        along = rows @ vectors
        height = ((along.real**2 + along.imag**2) @ (1 / np.sqrt(values))[..., None])[..., 0]
        mu = mu * height
        mu = mu / np.maximum(mu.sum(axis=-1, keepdims=True), _TINY)
    return np.asarray((vectors * np.sqrt(values)[..., None, :]) @ adjoint(vectors))
