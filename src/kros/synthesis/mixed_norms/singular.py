"""The published plant (37)-(39): neither control penalty nor measurement noise in channel 1, and T11 the same for every controller.

A small penalty and a small noise, a hundredth of what control and disturbances do anyway, make such a plant regular for the inequalities with
one Lyapunov matrix; every norm is recomputed on the plant as it was given.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.lti import StateSpace
from ...core.norms import h2_norm
from ..assumptions import Assumption, h2_violations
from ..generalized_plant import GeneralizedPlant

_SHARE = 1e-2
_CURABLE = (Assumption.CONTROL_PENALTY, Assumption.MEASUREMENT_NOISE)


def is_singular(plant: GeneralizedPlant) -> bool:
    """Tell whether channel 1 lacks control penalty or measurement noise, and nothing else."""
    found = h2_violations(plant.channel(plant.rows(1), plant.columns(1)))
    return bool(found) and all(v.assumption in _CURABLE for v in found)


def regularised(plant: GeneralizedPlant) -> GeneralizedPlant:
    """Return the plant with penalty outputs at the end of z1 and noise inputs at the end of w1."""
    n, n_w, n_u, n_z, n_y = plant.sizes
    z1, w1 = plant.C1[plant.rows(1)].shape[0], plant.B1[:, plant.columns(1)].shape[1]
    penalty = _SHARE * _sizes(
        plant.B2, np.vstack([plant.C1, plant.C2]), np.vstack([plant.D12, plant.D22]), plant, axis=0
    )
    noise = _SHARE * _sizes(np.hstack([plant.B1, plant.B2]), plant.C2, np.hstack([plant.D21, plant.D22]), plant, axis=1)
    return replace(
        plant,
        B1=np.insert(plant.B1, [w1] * n_y, np.zeros((n, n_y)), axis=1),
        C1=np.insert(plant.C1, [z1] * n_u, np.zeros((n_u, n)), axis=0),
        D11=np.insert(
            np.insert(plant.D11, [w1] * n_y, np.zeros((n_z, n_y)), axis=1),
            [z1] * n_u,
            np.zeros((n_u, n_w + n_y)),
            axis=0,
        ),
        D12=np.insert(plant.D12, [z1] * n_u, np.diag(penalty), axis=0),
        D21=np.insert(plant.D21, [w1] * n_y, np.diag(noise), axis=1),
        n_w1=w1 + n_y,
        n_z1=z1 + n_u,
        w_parts={},
        z_parts={},
    )


def _sizes(B: np.ndarray, C: np.ndarray, D: np.ndarray, plant: GeneralizedPlant, axis: int) -> np.ndarray:
    """H2 norms from every input (axis 0) or to every output (axis 1); of an unstable plant as if it were slowed down until it is stable."""
    A = plant.A / max(1.0, 1.05 * float(plant.open_loop().spectral_radius()))
    parts = [StateSpace(A, B[:, [i]], C, D[:, [i]], plant.dt) for i in range(B.shape[1])]
    if axis == 1:
        parts = [StateSpace(A, B, C[[i]], D[[i]], plant.dt) for i in range(C.shape[0])]
    found = np.array([h2_norm(part) for part in parts])
    return np.where(found > 0, found, max(found.max(initial=0.0), 1.0))
