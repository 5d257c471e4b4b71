r"""Matrices that no response of a system exceeds throughout a band of frequencies.

For a row t(z) of a stable system, and bands of the unit circle, a matrix is looked for with

.. math:: M_b \succeq t(z)^H t(z) \quad\text{for all } z \text{ in band } b, \qquad \mathrm{tr}(M_b W_b) \text{ small},

W_b the energies that it is for. Bands are covered by arcs, along which the response stays close to the straight segment
between two ends ``t_s``: no entry is further from it than ``delta_i`` (`Enclosure.segments`). The least matrix above
all ``t_s^H t_s``, and so above the squares on the segments, has the dual ``max tr(sum_s mu_s t_s^H t_s)^{1/2}`` over
weights mu that sum to one, which a multiplicative iteration solves; it is enlarged until it covers. For the rest, with
any sizes s_i > 0,

.. math:: d^H d \preceq \Big(\sum_i \delta_i s_i\Big) \mathrm{diag}(\delta_i / s_i) \quad (|d_i| \le \delta_i), \qquad
          (t + d)^H (t + d) \preceq (1 + \epsilon)\, t^H t + (1 + 1/\epsilon)\, d^H d .

Arcs are cut until the rest is a small share of the whole. Nothing is decided at points: what lies between them is in
delta.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.linalg import adjoint
from ...core.lti import StateSpace
from ...synthesis.worst_case.arcs import Enclosure

Array = npt.NDArray[Any]
_CLOSE = 0.004  # distance from segments, of a row's size in its band, or of its mean size over all of them
_ARCS, _MOST_ARCS = 20_000, 40_000  # at most, where an arc has a finite reach, and at all
_AT_ONCE = 4_000_000  # numbers of resolvents in memory
_ROUNDS = 30
_PARTS = 8  # most that an arc is cut into at once
_SPARE = 1.1
_SHAPED = 16  # responses of a band that the shape of a matrix is made for
_ITERATIONS = 16
_POWER = 4  # of the heights
_ENOUGH = 1.01  # a trace over the least one
_RIDGE = 1e-10
_TINY = np.finfo(float).tiny
_SAFE = 1 + 1e-9  # for rounding of small matrices


def majorants(system: StateSpace, edges: Array, weight: Array) -> Array | None:
    """Return matrices (p, b, m, m) above every row's responses in every band, or None."""
    size = np.sqrt(np.maximum(np.einsum("bii->i", weight).real, 0.0))
    size = np.where(size > 1e-100, size, 1.0)  # a channel without energy
    scaled = StateSpace(system.A, system.B * size, system.C, system.D * size, system.dt)
    W = weight / np.outer(size, size)
    W = W + _RIDGE * np.maximum(np.einsum("bii->b", W).real, _TINY)[:, None, None] * np.eye(len(size))
    values, vectors = np.linalg.eigh(W)
    root = (vectors * np.sqrt(values)[:, None, :]) @ adjoint(vectors)
    back = (vectors / np.sqrt(values)[:, None, :]) @ adjoint(vectors)
    sizes = np.sqrt(np.einsum("bii->bi", W).real)
    band, T, reach = _arcs(scaled, edges, root, sizes)
    if not np.isfinite(reach).all():
        return None

    n_bands, (p, m) = len(edges) - 1, T.shape[2:]
    far = np.stack([reach[band == b].max(axis=0) for b in range(n_bands)])
    band = np.repeat(band, 2)
    t = T.reshape(-1, p, m) @ root[band]
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


def _arcs(system: StateSpace, edges: Array, root: Array, sizes: Array) -> tuple[Array, Array, Array]:
    """Return every arc's band, the ends of its segment, (k, 2, p, m), and the distances from it, (k, p, m)."""
    enclosed, n_bands = Enclosure(system), len(edges) - 1
    theta, half, band = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2 * _SAFE, np.arange(n_bands)
    done: list[tuple[Array, Array, Array, Array]] = []
    peak, tried = np.zeros((n_bands, system.n_outputs)), len(theta)
    for remaining in reversed(range(_ROUNDS)):
        pieces = -(-len(theta) * max(system.n_states, 1) ** 2 // _AT_ONCE)
        some = [
            enclosed.segments(*own)
            for own in zip(np.array_split(theta, pieces), np.array_split(half, pieces), strict=True)
        ]
        T, reach = (np.concatenate(each) for each in zip(*some, strict=True))
        np.maximum.at(peak, band, np.sum(np.abs(T @ root[band][:, None]) ** 2, axis=-1).max(axis=1))
        allowed = _CLOSE * np.sqrt(np.maximum(peak, peak.mean(axis=0)))
        over = (np.einsum("kpi,ki->kp", reach, sizes[band]) / np.maximum(allowed[band], _TINY)).max(axis=1)
        parts = np.where(over > 1, np.ceil(np.clip(_SPARE * np.sqrt(over), 2, _PARTS)), 0).astype(int)
        if tried + parts.sum() > _ARCS:
            parts[np.isfinite(over)] = 0
        if not remaining or tried + parts.sum() > _MOST_ARCS:
            parts[:] = 0
        kept = parts == 0
        done.append((theta[kept], band[kept], T[kept], reach[kept]))
        if kept.all():
            break
        tried += parts.sum()
        place = np.concatenate([2 * np.arange(k) + 1 - k for k in parts])
        half, band = np.repeat(half / np.maximum(parts, 1), parts), np.repeat(band, parts)
        theta = np.repeat(theta, parts) + place * half
    theta, band, T, reach = (np.concatenate(each) for each in zip(*done, strict=True))
    order = np.argsort(theta)
    return band[order], T[order], reach[order]


def _some(rows: Array) -> Array:
    """Return as many responses for every band, evenly spread, shape (_SHAPED, p, m)."""
    return np.asarray(rows[np.linspace(0, len(rows) - 1, _SHAPED).round().astype(int)])


def _least_above(rows: Array) -> Array:
    """Return the matrices (b, p, m, m) of least trace above the squares of rows (b, s, p, m), but for scale."""
    n_bands, _, p, m = rows.shape
    rows = np.ascontiguousarray(np.swapaxes(rows, 1, 2)).reshape(n_bands * p, -1, m)
    mu = np.full(rows.shape[:2], 1 / rows.shape[1])
    ridge = (_RIDGE * np.sum(rows.real**2 + rows.imag**2, axis=(1, 2)) + _TINY)[:, None, None] * np.eye(m)
    found, least, left = np.zeros((len(rows), m, m), complex), np.full(len(rows), np.inf), np.arange(len(rows))
    for _ in range(_ITERATIONS):
        values, vectors = np.linalg.eigh((adjoint(rows) * mu[:, None, :]) @ rows + ridge)
        along = rows @ vectors
        height = ((along.real**2 + along.imag**2) @ (1 / np.sqrt(values))[..., None])[..., 0]
        excess = height.max(axis=-1) / np.maximum(
            np.sum(mu * height, axis=-1), _TINY
        )  # of the trace over that of the dual
        better = excess < least[left]
        least[left] = np.minimum(least[left], excess)
        vectors, values = vectors[better], values[better]
        found[left[better]] = (vectors * np.sqrt(values)[:, None, :]) @ adjoint(vectors)
        on = excess > _ENOUGH
        if not on.any():
            break
        left, rows, ridge, height = left[on], rows[on], ridge[on], height[on]
        mu = mu[on] * (height / height.max(axis=-1, keepdims=True)) ** _POWER
        mu = mu / mu.sum(axis=-1, keepdims=True)
    return found.reshape(n_bands, p, m, m)
