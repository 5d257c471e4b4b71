"""Mixed synthesis of plants without control penalty or measurement noise in channel 1, such as the published plant (37)-(39).

Such plants have no regular optimum: gains grow without bound as the infimum is approached. A small penalty and a small noise, a hundredth of what
control and disturbances do anyway, make them regular; every norm is recomputed on the plant as it was given.

Where w1 does not reach y, or u does not reach z1, T11 does not depend on the controller at all: every controller that meets the constraint is
optimal. Then the controller of the unscaled inequalities with one Lyapunov matrix is returned, as published, and a note says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...core.lti import StateSpace
from ...core.norms import h2_norm
from ..assumptions import Assumption, h2_violations
from ..generalized_plant import GeneralizedPlant
from .channels import Verified, verify

_SHARE = 1e-2
_NOTHING = 1e-9
_CURABLE = (Assumption.CONTROL_PENALTY, Assumption.MEASUREMENT_NOISE)


def is_singular(plant: GeneralizedPlant) -> bool:
    """Tell whether channel 1 lacks control penalty or measurement noise, and nothing else."""
    found = h2_violations(plant.channel(plant.rows(1), plant.columns(1)))
    return bool(found) and all(v.assumption in _CURABLE for v in found)


def regularised(plant: GeneralizedPlant, share: float = _SHARE) -> GeneralizedPlant:
    """Return the plant with penalty outputs at the end of z1 and noise inputs at the end of w1."""
    n, n_w, n_u, n_z, n_y = plant.sizes
    z1, w1 = plant.C1[plant.rows(1)].shape[0], plant.B1[:, plant.columns(1)].shape[1]
    penalty = share * _sizes(plant.B2, np.vstack([plant.C1, plant.C2]), np.vstack([plant.D12, plant.D22]), plant, axis=0)
    noise = share * _sizes(np.hstack([plant.B1, plant.B2]), plant.C2, np.hstack([plant.D21, plant.D22]), plant, axis=1)
    return replace(
        plant,
        B1=np.insert(plant.B1, [w1] * n_y, np.zeros((n, n_y)), axis=1),
        C1=np.insert(plant.C1, [z1] * n_u, np.zeros((n_u, n)), axis=0),
        D11=np.insert(np.insert(plant.D11, [w1] * n_y, np.zeros((n_z, n_y)), axis=1), [z1] * n_u, np.zeros((n_u, n_w + n_y)), axis=0),
        D12=np.insert(plant.D12, [z1] * n_u, np.diag(penalty), axis=0),
        D21=np.insert(plant.D21, [w1] * n_y, np.diag(noise), axis=1),
        n_w1=w1 + n_y,
        n_z1=z1 + n_u,
        w_parts={},
        z_parts={},
    )


def is_degenerate(plant: GeneralizedPlant) -> bool:
    """Tell whether T11 is the same for every controller: w1 does not reach y, or u does not reach z1."""
    one_z, one_w = plant.rows(1), plant.columns(1)
    to_y = _response(plant, plant.B1[:, one_w], plant.C2, plant.D21[:, one_w])
    to_z = _response(plant, plant.B2, plant.C1[one_z], plant.D12[one_z])
    return min(to_y, to_z) <= _NOTHING


def on_the_plant(plant: GeneralizedPlant, found: Sequence[Verified], gamma: float) -> list[Verified]:
    """Norms of the plant as it was given, for controllers of the regularised one."""
    verdicts = (verify(plant, v.controller, gamma, v.origin, v.solver, v.optimal) for v in found)
    return [v for v in verdicts if isinstance(v, Verified)]


def _sizes(B: np.ndarray, C: np.ndarray, D: np.ndarray, plant: GeneralizedPlant, axis: int) -> np.ndarray:
    """H2 norms from every input (axis 0) or to every output (axis 1); of an unstable plant as if it were slowed down until it is stable."""
    A = plant.A / max(1.0, 1.05 * float(plant.open_loop().spectral_radius()))
    parts = [StateSpace(A, B[:, [i]], C, D[:, [i]], plant.dt) for i in range(B.shape[1])]
    if axis == 1:
        parts = [StateSpace(A, B, C[[i]], D[[i]], plant.dt) for i in range(C.shape[0])]
    found = np.array([h2_norm(part) for part in parts])
    return np.where(found > 0, found, max(found.max(initial=0.0), 1.0))


def _response(plant: GeneralizedPlant, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> float:
    """Largest Markov parameter over what it would be if nothing cancelled."""
    size, found, state = float(np.linalg.norm(D)), float(np.linalg.norm(D)), B
    scale = max(1.0, float(plant.open_loop().spectral_radius()))
    for _ in range(2 * len(plant.A)):
        found = max(found, float(np.linalg.norm(C @ state)))
        size = max(size, float(np.linalg.norm(np.abs(C) @ np.abs(state))))
        state = plant.A @ state / scale
    return found / size if size > 0 else 0.0
