"""Generalized plants from whole matrices, and the one of the SLICOT examples SB10DD and SB10ED."""

import numpy as np

from kros.synthesis import GeneralizedPlant


def partition(A, B, C, D, n_y, n_u, dt):
    """The plant whose last inputs are controls and whose last outputs are measurements."""
    A, B, C, D = (np.array(x, dtype=float) for x in (A, B, C, D))
    B1, B2, C1, C2, z, y = B[:, :-n_u], B[:, -n_u:], C[:-n_y], C[-n_y:], D[:-n_y], D[-n_y:]
    return GeneralizedPlant(A, B1, B2, C1, C2, z[:, :-n_u], z[:, -n_u:], y[:, :-n_u], y[:, -n_u:], dt)


def slicot_discrete():
    """Discrete plant of the routines SB10DD (H-infinity) and SB10ED (H2): five inputs and outputs, two of them of the controller."""
    A = [
        [-0.7, 0.0, 0.3, 0.0, -0.5, -0.1],
        [-0.6, 0.2, -0.4, -0.3, 0.0, 0.0],
        [-0.5, 0.7, -0.1, 0.0, 0.0, -0.8],
        [-0.7, 0.0, 0.0, -0.5, -1.0, 0.0],
        [0.0, 0.3, 0.6, -0.9, 0.1, -0.4],
        [0.5, -0.8, 0.0, 0.0, 0.2, -0.9],
    ]
    B = [
        [-1, -2, -2, 1, 0],
        [1, 0, 1, -2, 1],
        [-3, -4, 0, 2, -2],
        [1, -2, 1, 0, -1],
        [0, 1, -2, 0, 3],
        [1, 0, 3, -1, -2],
    ]
    C = [[1, -1, 2, -2, 0, -3], [-3, 0, 1, -1, 1, 0], [0, 2, 0, -4, 0, -2], [1, -3, 0, 0, 3, 1], [0, 1, -2, 1, 0, -2]]
    D = [[1, -1, -2, 0, 0], [0, 1, 0, 1, 0], [2, -1, -3, 0, 1], [0, 1, 0, 1, -1], [0, 0, 1, 2, 1]]
    return partition(A, B, C, D, 2, 2, 1.0)
