r"""Exact search for the best nominal among many candidates (`identify.refine.minimax`).

Plants are tall here: wide ones are transposed, with the dual form; as `E_ia(G^T, Gp^T) = -E_ia(Gp, G)^T`, the inverse
additive form then has nominal and perturbed plant exchanged. With `G^+ = L Q^H`, L small and triangular, `sigma(D G^+)
= sigma(D L)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.small_matrices import entries_first, lower_factor, multiply, pseudo_inverse_first, sigma_max_first
from ...identify.refine.minimax import smallest_largest
from ..forms import Form

Array = npt.NDArray[Any]

_VECTOR = 16000  # complex numbers in a vector


@dataclass(frozen=True, eq=False)
class Plants:
    """Responses with what residuals need of them, entries first: (p, m, unit, frequency)."""

    G: Array  # (p, m, unit, frequency), p >= m
    P: Array | None  # (m, p, unit, frequency), or None: pseudo-inverses, for the forms that need them
    L: Array | None  # (m, m, unit, frequency), or None: triangles with `P P^H = L L^H`

    def part(self, *index: Any) -> Plants:
        """Return some units and frequencies; two integer arrays are matched, as in NumPy."""
        key = (slice(None), slice(None), *index)
        return Plants(self.G[key], None if self.P is None else self.P[key], None if self.L is None else self.L[key])

    def one(self, unit: int) -> Plants:
        """Return one unit, with its axis."""
        return self.part(slice(unit, unit + 1))


@dataclass(frozen=True)
class Geometry:
    """A form for tall plants, and whether they were transposed for it."""

    form: Form
    wide: bool

    @classmethod
    def of(cls, form: Form, shape: tuple[int, int]) -> Geometry:
        """Return the geometry for plants of a shape (outputs, inputs)."""
        wide = shape[0] < shape[1]
        return cls(form.dual if wide else form, wide)

    def plants(self, responses: Array) -> Plants:
        """Prepare responses of shape (unit, frequency, p, m), some units at a time."""
        G = entries_first(np.swapaxes(responses, -1, -2) if self.wide else responses)
        if self.form is Form.ADDITIVE:
            return Plants(G, None, None)
        p, m, n_units, n_freqs = G.shape
        inverse = self.form in (Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE, Form.INVERSE_ADDITIVE)
        factor = self.form in (Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE, Form.INVERSE_ADDITIVE)
        P = np.empty((m, p, n_units, n_freqs), complex) if inverse else None
        L = np.empty((m, m, n_units, n_freqs), complex) if factor else None
        for rows in blocks(n_units, n_freqs):
            pseudo_inverses = pseudo_inverse_first(np.moveaxis(G[:, :, rows], (0, 1), (-2, -1)))
            if P is not None:
                P[:, :, rows] = pseudo_inverses
            if L is not None:
                L[:, :, rows] = lower_factor(pseudo_inverses)
        return Plants(G, P, L)

    def sigma(self, nominal: Plants, units: Plants) -> Array:
        """Return the largest singular value of the residuals; the axes of units and frequencies broadcast."""
        D = units.G - nominal.G
        if self.form is Form.ADDITIVE:
            return sigma_max_first(D)
        if self.form is Form.INVERSE_ADDITIVE:
            first, second = (nominal, units) if self.wide else (units, nominal)
            return sigma_max_first(multiply(multiply(_known(first.P), D), _known(second.L)))
        base = (
            units if self.form in (Form.INVERSE_INPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE) else nominal
        )
        if self.form in (Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE):
            return sigma_max_first(multiply(_known(base.P), D))
        return sigma_max_first(multiply(D, _known(base.L)))


def search(geometry: Geometry, units: Plants) -> tuple[int, Array, Array, Array]:
    """Return the unit of the lowest peak, its bound, peaks or lower bounds of all, and which are exact."""
    count, n_freqs = units.G.shape[2:]

    def against(rows: Array, witness: Array) -> Array:
        one_each = units.part(witness, np.arange(n_freqs))
        parts = blocks(len(rows), n_freqs)
        return np.concatenate([geometry.sigma(units.part(rows[part]), one_each.part(None)) for part in parts])

    def bound(row: int) -> tuple[Array, Array]:
        return bound_of(geometry, units.one(row), units)

    return smallest_largest((count, n_freqs), _central(units), bound, against, lambda found: found.max(axis=-1))


def bound_of(geometry: Geometry, nominal: Plants, units: Plants) -> tuple[Array, Array]:
    """Return the largest residual over the units and which unit it is, both of shape (frequency,)."""
    n_units, n_freqs = units.G.shape[2:]
    largest, who = np.full(n_freqs, -1.0), np.zeros(n_freqs, int)
    for rows in blocks(n_units, n_freqs):
        sigma = geometry.sigma(nominal, units.part(rows))
        worst = np.argmax(sigma, axis=0)
        value = np.take_along_axis(sigma, worst[None], axis=0)[0]
        more = value > largest
        largest[more], who[more] = value[more], worst[more] + rows.start
    return largest, who


def blocks(n_rows: int, n_freqs: int) -> list[slice]:
    """Return slices of rows that make vectors of a good length."""
    step = max(1, _VECTOR // n_freqs)
    return [slice(start, min(start + step, n_rows)) for start in range(0, n_rows, step)]


def _central(candidates: Plants) -> int:
    """Return the candidate closest to the mean at a few frequencies, to begin with."""
    G = candidates.G[..., np.linspace(0, candidates.G.shape[3] - 1, 8).astype(int)]
    distance = np.abs(G - G.mean(axis=2, keepdims=True)).max(axis=(0, 1))
    return int(np.argmin((distance / np.maximum(distance.max(axis=0), 1e-300)).max(axis=1)))


def _known(factor: Array | None) -> Array:
    assert factor is not None
    return factor
