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

import numpy as np

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.norms import h2_norm, hinf_norm
from ...core.rounding import ROUNDING
from ..assumptions import require
from ..generalized_plant import GeneralizedPlant
from ..result import Status, Synthesis
from .equations import absorb_feedthrough, riccati_pair

_AGREEMENT = 1e-4  # of the norm with its promise


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
    K, promised, rounding = _optimum(plant)
    K = absorb_feedthrough(K, plant.D22)
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


def _optimum(p: GeneralizedPlant) -> tuple[StateSpace, float, float]:
    """Return the optimal controller for D22 = 0, its norm by the Riccati solutions, and the rounding of that norm."""
    X, Y = riccati_pair(p, "H2 synthesis")
    sampled = float(p.dt > 0)  # in continuous time nothing is known of the same moment
    ahead = p.A if sampled else np.eye(len(p.A))
    R, S = p.D12.T @ p.D12 + sampled * (p.B2.T @ X @ p.B2), p.D21 @ p.D21.T + sampled * (p.C2 @ Y @ p.C2.T)
    F = -np.linalg.solve(R, p.B2.T @ X @ ahead + p.D12.T @ p.C1)
    F0 = -sampled * np.linalg.solve(R, p.B2.T @ X @ p.B1 + p.D12.T @ p.D11)
    L = np.linalg.solve(S, p.C2 @ Y @ ahead.T + p.D21 @ p.B1.T).T
    L0 = sampled * np.linalg.solve(S, (F @ Y @ p.C2.T + F0 @ p.D21.T).T).T
    C = F - L0 @ p.C2
    K = StateSpace(p.A - L @ p.C2 + p.B2 @ C, L + p.B2 @ L0, C, L0, p.dt)
    terms = [np.trace(p.D11.T @ p.D11 + p.B1.T @ X @ p.B1), -np.trace(F0.T @ R @ F0)]  # of full information
    terms += [np.trace(R @ (F @ Y @ F.T + F0 @ F0.T)), -np.trace(R @ L0 @ S @ L0.T)]
    rounding = ROUNDING * sum(abs(term) for term in terms)  # the terms may cancel
    return K, float(np.sqrt(max(sum(terms), 0.0))), float(np.sqrt(rounding))
