"""The two channels of a mixed problem: T11 from w1 to z1 (performance), T22 from w2 to z2 (uncertainty)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.norms import h2_norm, hinf_norm
from ..generalized_plant import GeneralizedPlant
from ..riccati.hinf import proven_bound

_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class Verified:
    """A controller with its recomputed norms, how it came about, and whether it is the optimum of its inequalities."""

    controller: StateSpace
    h2: float
    hinf: float
    margin: float
    origin: str
    optimal: bool = True


def part(plant: GeneralizedPlant, closed: StateSpace, channel: int) -> StateSpace:
    """Cut T11 (channel 1) or T22 (channel 2) out of the closed loop."""
    rows, columns = plant.rows(channel), plant.columns(channel)
    return StateSpace(closed.A, closed.B[:, columns], closed.C[rows], closed.D[rows][:, columns], closed.dt)


def verify(
    plant: GeneralizedPlant, controller: StateSpace, gamma: float, origin: str, optimal: bool = True
) -> Verified | str:
    """Recompute everything on the plant; return what was found, or why the controller is rejected."""
    if not all(np.isfinite(getattr(controller, name)).all() for name in "ABCD"):
        return f"{origin}: the controller is not finite"
    closed = plant.close(controller)
    margin = closed.largest_pole()
    if not closed.is_stable():
        return f"{origin}: closed loop unstable, spectral radius {margin:.6g}"
    norm, peak = h2_norm(part(plant, closed, 1)), hinf_norm(part(plant, closed, 2))
    if peak >= gamma:
        return f"{origin}: ||T22|| = {peak:.6g} is not below {gamma:g}"
    if not np.isfinite(norm):
        return f"{origin}: ||T11||_2 is infinite"
    return Verified(controller, norm, peak, margin, origin, optimal)


def scaled(plant: GeneralizedPlant, a: float) -> GeneralizedPlant:
    """Scale channel 2: ``w2 -> a w2``, ``z2 -> z2 / a``."""
    left, right = np.ones(plant.sizes[3]), np.ones(plant.sizes[1])
    left[plant.rows(2)], right[plant.columns(2)] = 1 / a, a
    D11 = plant.D11 * left[:, None] * right
    return replace(
        plant,
        B1=plant.B1 * right,
        D21=plant.D21 * right,
        C1=plant.C1 * left[:, None],
        D12=plant.D12 * left[:, None],
        D11=D11,
    )


def require_reachable(plant: GeneralizedPlant, gamma: float, attained: float | None = None) -> None:
    """Raise a `SynthesisError` when the proven bound of ||T22|| shows that no controller attains the level."""
    two = plant.channel(plant.rows(2), plant.columns(2))
    if 0 in (two.sizes[1], two.sizes[3]):
        return
    if attained is None:
        loop = two.open_loop()
        attained = hinf_norm(loop) if loop.is_stable() else 10 * gamma
    least = proven_bound(two, max(attained, 2 * gamma))
    if least >= gamma:
        raise SynthesisError(
            f"Mixed synthesis: gamma = {gamma:g} is infeasible, no controller has ||T22|| below {least:.6g}; raise gamma, or make the weights of "
            "channel 2 smaller."
        )
