"""Responses of diagonal systems that are chains of sections, as `spectral` makes them: closed forms on long vectors of frequencies."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace

Array = npt.NDArray[Any]


def diagonal_response(system: StateSpace, freqs_hz: npt.ArrayLike) -> Array:
    """Return the diagonal of the response of one square system, shape (frequency, size); chains of sections from the last block up."""
    freqs = np.asarray(freqs_hz, float)
    blocks = _blocks(system.A)
    if any(b.stop - b.start > 2 for b in blocks):
        return np.asarray(np.einsum("fii->fi", system.frequency_response(freqs)))
    s = 2j * np.pi * freqs
    zeta = np.expm1(s * system.dt) if system.dt > 0 else s
    A = system.A - np.eye(system.n_states) if system.dt > 0 else system.A
    columns = [_channel(A, system.B[:, i], system.C[i], system.D[i, i], zeta, blocks) for i in range(system.n_outputs)]
    return np.stack(columns, axis=-1)


def _blocks(A: Array) -> list[slice]:
    """Diagonal blocks of a block upper triangular matrix, as small as possible."""
    n = len(A)
    ends = [k for k in range(1, n + 1) if not A[k:, :k].any()]
    return [slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True)] if n else []


def _channel(A: Array, b: Array, c: Array, d: float, zeta: Array, blocks: list[slice]) -> Array:
    """Response from one input to one output."""
    states: dict[int, Array] = {}
    out = np.full(zeta.shape, d, complex)
    for block in reversed(blocks):
        rows = range(block.start, block.stop)
        right = {k: b[k] + sum(A[k, j] * x for j, x in states.items() if A[k, j]) for k in rows}
        if not any(np.any(r) for r in right.values()):
            continue
        if len(rows) == 1:
            states[block.start] = right[block.start] / (zeta - A[block.start, block.start])
            continue
        i, j = rows
        first, second = zeta - A[i, i], zeta - A[j, j]
        size = first * second - A[i, j] * A[j, i]
        states[i] = (second * right[i] + A[i, j] * right[j]) / size
        states[j] = (first * right[j] + A[j, i] * right[i]) / size
    for k, x in states.items():
        if c[k]:
            out += c[k] * x
    return out
