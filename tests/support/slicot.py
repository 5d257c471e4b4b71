"""Generalized plants from whole matrices, and the one of the SLICOT examples SB10DD and SB10ED."""

import json
from pathlib import Path

import numpy as np

from kros.synthesis import GeneralizedPlant


def partition(A, B, C, D, n_y, n_u, dt):
    """The plant whose last inputs are controls and whose last outputs are measurements."""
    A, B, C, D = (np.array(x, dtype=float) for x in (A, B, C, D))
    B1, B2, C1, C2, z, y = B[:, :-n_u], B[:, -n_u:], C[:-n_y], C[-n_y:], D[:-n_y], D[-n_y:]
    return GeneralizedPlant(A, B1, B2, C1, C2, z[:, :-n_u], z[:, -n_u:], y[:, :-n_u], y[:, -n_u:], dt)


def slicot_discrete():
    """Discrete plant of the routines SB10DD (H-infinity) and SB10ED (H2), and the printed H2 controller."""
    data = json.loads((Path(__file__).parents[1] / "oracle" / "data" / "slicot_discrete.json").read_text())
    return partition(*(data[name] for name in "ABCD"), 2, 2, 1.0), data["controller"]
