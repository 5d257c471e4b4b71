"""Interconnection of systems by named wires: every block once, so that no state is there twice.

Symbols
-------
x, v, y : states, inputs and outputs of all blocks, stacked;  w, z : inputs and outputs of the whole
F, H, P, Q : ``v = F y + H w``,  ``z = P y + Q w``
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...core.arrays import AnyArray
from ...core.errors import DimensionError
from ...core.lti import StateSpace, block_diagonal
from ...core.rounding import SINGULAR

Sum = Mapping[str, AnyArray]


def interconnect(
    blocks: Mapping[str, StateSpace], wires: Mapping[str, Sum], inputs: Mapping[str, int], outputs: Mapping[str, Sum]
) -> StateSpace:
    """Return the system from `inputs` to `outputs`."""
    whole = block_diagonal(list(blocks.values()))
    sources = {name: block.n_outputs for name, block in blocks.items()}
    heights = {name: block.n_inputs for name, block in blocks.items()}
    F, H = _matrix(wires, heights, sources), _matrix(wires, heights, inputs)
    tall = {name: next(iter(row.values())).shape[0] for name, row in outputs.items()}
    P, Q = _matrix(outputs, tall, sources), _matrix(outputs, tall, inputs)
    loop = np.eye(len(F)) - F @ whole.D
    if len(F) and np.linalg.cond(loop) > SINGULAR:
        raise DimensionError("Interconnection: an algebraic loop has no solution; put a delay into it.")
    v = np.linalg.solve(loop, np.hstack([F @ whole.C, H]))
    v_x, v_w = v[:, : whole.n_states], v[:, whole.n_states :]
    return StateSpace(
        whole.A + whole.B @ v_x, whole.B @ v_w, P @ (whole.C + whole.D @ v_x), P @ whole.D @ v_w + Q, whole.dt
    )


def _matrix(rows: Mapping[str, Sum], heights: Mapping[str, int], widths: Mapping[str, int]) -> AnyArray:
    """Stack the matrices of all sums, zero where a sum does not name a source."""
    return np.block(
        [
            [rows.get(name, {}).get(source, np.zeros((height, width))) for source, width in widths.items()]
            for name, height in heights.items()
        ]
    )
