r"""What no correction of a model is better than for a set of signals, proven.

Every cover of the units is above the mean of their energies in bands, so a process whose energies stay below that mean is in the set, in the limit of long
recordings, whatever cover is taken. Two such processes give bounds, and the larger one counts, for every state by itself.

*Even in every band.* At every frequency the error of any correction is ``G r - Q (C G r + n)``, ``G = (z I - A)^{-1}``, with some Q; the least over
all Q, causal or not, has the spectrum

.. math:: P = G\, S^{1/2} (I + S^{1/2} G^H C^H R^{-1} C G S^{1/2})^{-1} S^{1/2} G^H .

Its mean over the circle is taken by quadrature at two resolutions, less their difference.

*Rational.* A shaping filter is made smaller until its output is inside: with ``M_b`` above ``G G^H`` throughout band b its energy there is at most ``M_b``
times the width over pi. What no predictor beats for it (`predictor_bound`) is a bound by proof, close where spectra are smooth.

The slopes of lifted functions rest at their mean: one of the courses that a certificate allows.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from ...core.errors import SynthesisError
from ...core.linalg import adjoint
from ...core.lti import StateSpace
from ...synthesis.residual_shaped.shaping_filter import Array, Basis, shaping_filter
from ...synthesis.riccati.filter_bound import predictor_bound
from ...uncertainty.coprime.signals import SignalSet
from ..certificate.majorants import majorants

_INSIDE = 16  # points of quadrature in a band
_SPLIT = 4  # parts of every band in which the energy of a filter is bounded
_POINTS = 2049
_BASES = (Basis(4, (0.8, 0.95, 0.98)), Basis(8, (0.95, 0.98)), Basis(8, (0.9, 0.97, 0.99, 0.997)))


def signal_lower_bounds(A: Array, C: Array, noise: Array, signals: SignalSet, dt: float) -> Array:
    """Return root mean squares of every state's error that no correction of a model beats over the set; NaN where none is proven."""
    n, q = len(A), len(C)
    size = 2.0 ** np.round(
        np.log2(np.sqrt(np.maximum(signals.energies.mean_square.mean(axis=0), np.finfo(float).tiny)))
    )
    A, C, signals = A * size / size[:, None], C * size, replace(signals, energies=signals.energies.scaled(size))
    C = C / noise[:, None]
    best, edges, mean = np.full(n, np.nan), signals.energies.edges, signals.energies.energy.mean(axis=0)
    spectrum = signals.spectrum(_POINTS, np.full(len(signals.unit_ids), 1 / len(signals.unit_ids)))
    for basis in _BASES:
        try:
            inside = scaled_into(shaping_filter(spectrum, basis, dt), edges, mean)
        except SynthesisError:
            continue
        k, s = inside.n_inputs, inside.n_states
        whole = np.block([[A, inside.C], [np.zeros((s, n)), inside.A]])
        driven = np.hstack([np.vstack([inside.D, inside.B]), np.zeros((n + s, q))])
        seen, direct = np.hstack([C, np.zeros((q, s))]), np.hstack([np.zeros((q, k)), np.eye(q)])
        found = [predictor_bound(whole, driven, seen, direct, row[None]) for row in np.eye(n, n + s)]
        best = np.fmax(best, np.sqrt([np.nan if value is None else value for value in found]))
    return np.asarray(np.fmax(best, even_bound(A, C, edges, mean)) * size)


def even_bound(A: Array, C: Array, edges: Array, energies: Array) -> Array:
    """Return what no estimate, causal or not, beats for a process that is even in every band; noise of unit variance, shape (n,)."""
    values, vectors = np.linalg.eigh(energies * (np.pi / np.diff(edges))[:, None, None])
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ adjoint(vectors)
    coarse, fine = (_even(A, C, edges, root, points) for points in (_INSIDE, 2 * _INSIDE))
    return np.asarray(np.sqrt(np.maximum(fine - 2 * np.abs(fine - coarse), 0.0)))


def _even(A: Array, C: Array, edges: Array, root: Array, points: int) -> Array:
    """Mean squares by the rule of Gauss in every band."""
    x, weight = np.polynomial.legendre.leggauss(points)
    theta = (edges[:-1, None] + edges[1:, None] + np.diff(edges)[:, None] * x) / 2
    n, q = len(A), len(C)
    G = np.linalg.solve(
        np.exp(1j * theta)[..., None, None] * np.eye(n) - A, np.broadcast_to(root[:, None], (*theta.shape, n, n))
    )
    seen = C @ G
    removed = adjoint(seen) @ np.linalg.solve(np.eye(q) + seen @ adjoint(seen), seen)
    P = np.einsum("bpij,bpjk,bpik->bpi", G, np.eye(n) - removed, G.conj(), optimize=True).real
    return np.asarray(np.einsum("b,p,bpi->i", np.diff(edges) / 2 / np.pi, weight, P))


def scaled_into(shaping: StateSpace, edges: Array, energies: Array) -> StateSpace:
    """Return a shaping filter made smaller, until the energies of its output are below given ones in every band, proven; these are (b, n, n)."""
    n = shaping.n_outputs
    fine = np.concatenate([*(np.linspace(low, high, _SPLIT + 1)[:-1] for low, high in pairwise(edges)), edges[-1:]])
    turned = StateSpace(shaping.A.T, shaping.C.T, shaping.B.T, shaping.D.T, shaping.dt)
    size = np.sqrt(np.einsum("bii->bi", energies).real)
    scaled = energies / size[:, :, None] / size[:, None, :]
    weight = np.repeat(np.linalg.inv(scaled) / size[:, :, None] / size[:, None, :], _SPLIT, axis=0).conj()
    majorant = majorants(turned, fine, weight)
    if majorant is None:  # without energy it is below any
        return StateSpace(shaping.A, 0.0 * shaping.B, shaping.C, 0.0 * shaping.D, shaping.dt)
    above = majorant.sum(axis=0).conj()  # rows of the transposed filter are columns of G: above G G^H
    found = (above * (np.diff(fine) / np.pi)[:, None, None]).reshape(-1, _SPLIT, n, n).sum(axis=1)
    root = np.linalg.inv(np.linalg.cholesky(scaled)) / size[:, None, :]
    largest = float(np.linalg.eigvalsh(root @ found @ adjoint(root))[..., -1].max())
    factor = np.sqrt(1 / (largest * (1 + 1e-9)))
    return StateSpace(shaping.A, shaping.B * factor, shaping.C, shaping.D * factor, shaping.dt)
