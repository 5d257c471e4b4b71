r"""Lower bound of the structured singular value: perturbations found by the power iteration, and what they are worth.

Any Delta of the structure with norm one gives ``rho(M Delta) <= mu(M)``. At a local maximum of the spectral radius there are vectors with

    M b = beta a,      M^H l = beta r,
    l_i = (|r_i| / |a_i|) a_i,     b_i = (|a_i| / |r_i|) r_i        for full blocks,
    l_i = e^{-j phi_i} r_i,        b_i = e^{j phi_i} a_i            for repeated scalars, phi_i the angle of a_i^H r_i,

and the iteration cycles through these equations, from several starts, at all frequencies at once. It need not converge: only the spectral radius of
``M Delta``, recomputed, counts, with ``Delta_i = r_i a_i^H / (|r_i| |a_i|)`` or ``e^{j phi_i} I``.

Symbols
-------
b, r : (f, w);  a, l : (f, z);  phases : e^{j phi}

References
----------
A. Packard, M. K. H. Fan and J. Doyle, "A power method for the structured singular value", 27th CDC (1988) 2132-2137.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.linalg import adjoint
from .blocks import Structure

Array = npt.NDArray[Any]

_TINY = 1e-300


def power_iteration(M: Array, structure: Structure, starts: int = 5, iterations: int = 60) -> tuple[Array, Array]:
    """Return lower bounds, shape (f,), and perturbations of norm one that attain them, shape (f, w, z).

    Parameters
    ----------
    M : ndarray, shape (f, z, w)
    structure : Structure
    starts : int
        The first from the singular vectors of M, the others random, the same at every call.
    iterations : int
        From every start.
    """
    rng = np.random.default_rng(0)
    best, chosen = np.full(len(M), -1.0), np.zeros((len(M), *structure.shape[::-1]), complex)
    _, _, Vh = np.linalg.svd(M)
    for start in range(starts):
        b = np.conj(Vh[:, 0]) if start == 0 else _random(rng, Vh.shape[:2])
        r = b if start == 0 else _random(rng, Vh.shape[:2])
        for _ in range(iterations):
            a = _unit(M @ b[..., None])
            left = _left(a, r, structure)
            r = _unit(adjoint(M) @ left[..., None])
            b = (_perturbation(a, r, structure) @ a[..., None])[..., 0]
        Delta = _perturbation(a, r, structure)
        value = np.abs(np.linalg.eigvals(M @ Delta)).max(axis=-1)
        better = value > best
        best, chosen = np.where(better, value, best), np.where(better[:, None, None], Delta, chosen)
    return best, chosen


def _left(a: Array, r: Array, structure: Structure) -> Array:
    left = np.empty_like(a)
    for block, rows, columns in zip(structure.blocks, structure.seen(), structure.driven(), strict=True):
        if block.repeated:
            left[:, rows] = np.conj(_phase(a[:, rows], r[:, columns])) * r[:, columns]
        else:
            left[:, rows] = a[:, rows] * (_norm(r[:, columns]) / np.maximum(_norm(a[:, rows]), _TINY))
    return left


def _perturbation(a: Array, r: Array, structure: Structure) -> Array:
    Delta = np.zeros((len(a), *structure.shape[::-1]), complex)
    for block, rows, columns in zip(structure.blocks, structure.seen(), structure.driven(), strict=True):
        if block.repeated:
            Delta[:, columns, rows] = _phase(a[:, rows], r[:, columns])[..., None] * np.eye(block.rows)
        else:
            to, of = _direction(r[:, columns]), _direction(a[:, rows])
            Delta[:, columns, rows] = to[..., :, None] * np.conj(of[..., None, :])
    return Delta


def _phase(a: Array, r: Array) -> Array:
    inner = np.sum(np.conj(a) * r, axis=-1, keepdims=True)
    return np.where(np.abs(inner) > _TINY, inner / np.maximum(np.abs(inner), _TINY), 1.0)


def _direction(x: Array) -> Array:
    first = np.zeros_like(x)
    first[..., 0] = 1.0
    size = _norm(x)
    return np.where(size > _TINY, x / np.maximum(size, _TINY), first)


def _norm(x: Array) -> Array:
    return np.asarray(np.linalg.norm(x, axis=-1, keepdims=True))


def _unit(x: Array) -> Array:
    return _direction(x[..., 0])


def _random(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    return _direction(rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
