r"""H2-optimal output feedback by two Riccati equations, discrete (proper controllers, all feedthroughs) and continuous.

Discrete time. With the full-information optimum ``u = F x + F0 w`` the cost of any other control is
:math:`\|T\|_2^2 = \mathrm{const} + \|R_b^{1/2}(u - F x - F_0 w)\|_2^2`; the best causal control is therefore the
conditional expectation of ``F x + F0 w`` given the measurements up to and including now:

    x_hat+ = A x_hat + B2 u + L nu,    u = F x_hat + L0 nu,    nu = y - C2 x_hat

In continuous time ``F0 = 0`` and ``L0 = 0``.

Symbols
-------
X, Y : solutions of the control and filter Riccati equations
R_b = D12' D12 + B2' X B2;   S_y = D21 D21' + C2 Y C2'
F = -R_b^-1 (B2' X A + D12' C1);   F0 = -R_b^-1 (B2' X B1 + D12' D11)
L = (A Y C2' + B1 D21') S_y^-1;   L0 = (F Y C2' + F0 D21') S_y^-1

References
----------
K. Zhou, J. C. Doyle, K. Glover, *Robust and Optimal Control*, sections 14.5 and 21.7.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.norms import h2_norm, hinf_norm
from ..assumptions import require
from ..generalized_plant import GeneralizedPlant
from ..result import Status, Synthesis
from .equations import absorb_feedthrough, solve_riccati

Array = npt.NDArray[Any]

_AGREEMENT, _ROUNDING = 1e-4, 1e-12  # of the norm with its promise, and of a sum with its terms


def h2(plant: GeneralizedPlant) -> Synthesis:
    """Return the controller with the smallest H2 norm from w to z.

    Parameters
    ----------
    plant : GeneralizedPlant
        ``D12`` of full column rank, ``D21`` of full row rank, and ``D11 = 0`` in continuous time.

    Returns
    -------
    Synthesis
        ``h2_norm`` is recomputed from the closed loop; ``lower_bound`` is the value that the Riccati solutions promise.

    Raises
    ------
    SynthesisError
        When an assumption fails (each is named, with the remedy), a Riccati equation has no solution, or the result
        does not survive verification.

    Examples
    --------
    >>> from kros.synthesis import GeneralizedPlant, h2
    >>> zero, D12, D21 = [[0, 0], [0, 0]], [[0], [1.0]], [[0, 1.0]]
    >>> plant = GeneralizedPlant([[0.9]], [[1.0, 0.0]], [[1.0]], [[1.0], [0.0]], [[1.0]], zero, D12, D21, [[0]], 1.0)
    >>> h2(plant).status.value
    'optimal'
    """
    require(plant, "H2 synthesis")
    start = time.perf_counter()
    gains = Gains.of(plant, "H2 synthesis")
    K, (promised, rounding) = absorb_feedthrough(gains.controller(plant), plant.D22), gains.norm(plant)
    elapsed = time.perf_counter() - start
    closed = plant.close(K)
    norm = h2_norm(closed)
    if not np.isfinite(norm) or abs(norm - promised) > _AGREEMENT * promised + rounding:
        raise SynthesisError(
            f"H2 synthesis: the closed loop has norm {norm:.9g} where the Riccati solutions promise {promised:.9g}; "
            "scale states, inputs and outputs to similar size."
        )
    lower = min(promised, norm)
    return Synthesis(
        method="h2",
        controller=K,
        status=Status.OPTIMAL,
        h2_norm=norm,
        hinf_norm=hinf_norm(closed),
        lower_bound=lower,
        gap_percent=100 * (norm / lower - 1) if lower > rounding else 0.0,
        spectral_radius=closed.largest_pole(),
        solve_s=elapsed,
        solver="riccati",
    )


@dataclass(frozen=True, eq=False)
class Gains:
    """The optimal gains of a plant, D22 = 0, and what they are made from; see the symbols above."""

    X: Array
    Y: Array
    R_b: Array
    S_y: Array
    F: Array
    F0: Array
    L: Array
    L0: Array

    @classmethod
    def of(cls, p: GeneralizedPlant, method: str) -> Gains:
        """Solve both Riccati equations."""
        R, S = p.D12.T @ p.D12, p.D21 @ p.D21.T
        X = solve_riccati(p.A, p.B2, p.C1.T @ p.C1, R, p.C1.T @ p.D12, p.dt, f"{method}, control")
        Y = solve_riccati(p.A.T, p.C2.T, p.B1 @ p.B1.T, S, p.B1 @ p.D21.T, p.dt, f"{method}, filter")
        if p.dt == 0:
            F = -np.linalg.solve(R, p.B2.T @ X + p.D12.T @ p.C1)
            L = np.linalg.solve(S, p.C2 @ Y + p.D21 @ p.B1.T).T
            return cls(X, Y, R, S, F, np.zeros((len(R), p.sizes[1])), L, np.zeros((len(R), len(S))))
        R, S = R + p.B2.T @ X @ p.B2, S + p.C2 @ Y @ p.C2.T
        F = -np.linalg.solve(R, p.B2.T @ X @ p.A + p.D12.T @ p.C1)
        F0 = -np.linalg.solve(R, p.B2.T @ X @ p.B1 + p.D12.T @ p.D11)
        L = np.linalg.solve(S, p.C2 @ Y @ p.A.T + p.D21 @ p.B1.T).T
        return cls(X, Y, R, S, F, F0, L, np.linalg.solve(S, (F @ Y @ p.C2.T + F0 @ p.D21.T).T).T)

    def controller(self, p: GeneralizedPlant) -> StateSpace:
        """Return the optimal controller for D22 = 0."""
        C = self.F - self.L0 @ p.C2
        return StateSpace(p.A - self.L @ p.C2 + p.B2 @ C, self.L + p.B2 @ self.L0, C, self.L0, p.dt)

    def norm(self, p: GeneralizedPlant) -> tuple[float, float]:
        """Return the norm that the solutions promise, and how far rounding may be from it: the terms may cancel."""
        F, F0, R = self.F, self.F0, self.R_b
        terms = [np.trace(p.D11.T @ p.D11 + p.B1.T @ self.X @ p.B1), -np.trace(F0.T @ R @ F0)]  # of full information
        terms += [np.trace(R @ (F @ self.Y @ F.T + F0 @ F0.T)), -np.trace(R @ self.L0 @ self.S_y @ self.L0.T)]
        squared, rounding = sum(terms), _ROUNDING * sum(abs(term) for term in terms)
        return float(np.sqrt(max(squared, 0.0))), float(np.sqrt(rounding))
