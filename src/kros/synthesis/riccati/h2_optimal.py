r"""H2-optimal output feedback by two Riccati equations, discrete (proper controllers, all feedthroughs) and continuous.

Discrete time. With the full-information optimum ``u = F x + F0 w`` the cost of any other control is
:math:`\|T\|_2^2 = \mathrm{const} + \|R_b^{1/2}(u - F x - F_0 w)\|_2^2`; the best causal control is therefore the conditional expectation of
``F x + F0 w`` given the measurements up to and including now:

    x_hat+ = A x_hat + B2 u + L nu,    u = F x_hat + L0 nu,    nu = y - C2 x_hat

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
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.norms import h2_norm, hinf_norm
from ..assumptions import require
from ..generalized_plant import GeneralizedPlant
from ..result import Status, Synthesis
from .equations import discrete_gain, solve_riccati

Array = npt.NDArray[Any]

_AGREEMENT, _ROUNDING = 1e-4, 1e-12


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
        When an assumption fails (each is named, with the remedy), a Riccati equation has no solution, or the result does not survive
        verification.

    Examples
    --------
    >>> from kros.synthesis import GeneralizedPlant, h2
    >>> plant = GeneralizedPlant([[0.9]], [[1.0, 0.0]], [[1.0]], [[1.0], [0.0]], [[1.0]], [[0, 0], [0, 0]], [[0], [1.0]], [[0, 1.0]], [[0]], 1.0)
    >>> h2(plant).status.value
    'optimal'
    """
    require(plant, "H2 synthesis")
    start = time.perf_counter()
    K, promised, rounding = (_discrete if plant.dt > 0 else _continuous)(plant)
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
        spectral_radius=stability_margin(closed),
        solve_s=elapsed,
        solver="riccati",
    )


def stability_margin(closed: StateSpace) -> float:
    """Spectral radius, or the largest real part in continuous time."""
    poles = closed.poles()
    return float(closed.spectral_radius()) if closed.dt > 0 else float(poles.real.max(initial=-np.inf))


def absorb_feedthrough(K: StateSpace, D22: Array) -> StateSpace:
    """Turn a controller for ``y - D22 u`` into one for ``y``."""
    if not np.any(D22):
        return K
    loop = np.eye(K.n_outputs) + K.D @ D22
    if np.linalg.cond(loop) > 1e12:
        raise SynthesisError(
            "Algebraic loop: the controller makes I + D^c D22 singular; add a delay to the plant, or change D22."
        )
    C, D = np.linalg.solve(loop, K.C), np.linalg.solve(loop, K.D)
    return StateSpace(K.A - K.B @ D22 @ C, K.B - K.B @ D22 @ D, C, D, K.dt)


def _discrete(p: GeneralizedPlant) -> tuple[StateSpace, float, float]:
    """Controller for D22 = 0, the norm it promises, and how far rounding may be from it."""
    R1, S1 = p.D12.T @ p.D12, p.C1.T @ p.D12
    R2, S2 = p.D21 @ p.D21.T, p.B1 @ p.D21.T
    X = solve_riccati(p.A, p.B2, p.C1.T @ p.C1, R1, S1, p.dt, "H2 synthesis, control")
    Y = solve_riccati(p.A.T, p.C2.T, p.B1 @ p.B1.T, R2, S2, p.dt, "H2 synthesis, filter")
    Rb, Sy = R1 + p.B2.T @ X @ p.B2, R2 + p.C2 @ Y @ p.C2.T
    F = discrete_gain(p.A, p.B2, R1, S1, X)
    F0 = -np.linalg.solve(Rb, p.B2.T @ X @ p.B1 + p.D12.T @ p.D11)
    L = -discrete_gain(p.A.T, p.C2.T, R2, S2, Y).T
    L0 = np.linalg.solve(Sy, (F @ Y @ p.C2.T + F0 @ p.D21.T).T).T
    C = F - L0 @ p.C2
    K = StateSpace(p.A - L @ p.C2 + p.B2 @ C, L + p.B2 @ L0, C, L0, p.dt)
    terms = [np.trace(p.D11.T @ p.D11 + p.B1.T @ X @ p.B1), -np.trace(F0.T @ Rb @ F0)]  # of full information
    terms += [np.trace(Rb @ (F @ Y @ F.T + F0 @ F0.T)), -np.trace(Rb @ L0 @ Sy @ L0.T)]  # of estimation
    return K, *_norm(terms)


def _continuous(p: GeneralizedPlant) -> tuple[StateSpace, float, float]:
    """Strictly proper controller for D22 = 0, D11 = 0, the norm it promises, and how far rounding may be from it."""
    R1, S1 = p.D12.T @ p.D12, p.C1.T @ p.D12
    R2, S2 = p.D21 @ p.D21.T, p.B1 @ p.D21.T
    X = solve_riccati(p.A, p.B2, p.C1.T @ p.C1, R1, S1, 0.0, "H2 synthesis, control")
    Y = solve_riccati(p.A.T, p.C2.T, p.B1 @ p.B1.T, R2, S2, 0.0, "H2 synthesis, filter")
    F = -np.linalg.solve(R1, p.B2.T @ X + S1.T)
    L = np.linalg.solve(R2, p.C2 @ Y + S2.T).T
    K = StateSpace(p.A + p.B2 @ F - L @ p.C2, L, F, np.zeros((F.shape[0], L.shape[1])), 0.0)
    return K, *_norm([np.trace(p.B1.T @ X @ p.B1), np.trace(R1 @ F @ Y @ F.T)])


def _norm(terms: list[float]) -> tuple[float, float]:
    """Root of a sum of terms that may cancel, and its rounding error; an optimum of zero is as large as rounding makes it."""
    squared, rounding = sum(terms), _ROUNDING * sum(abs(term) for term in terms)
    return float(np.sqrt(max(squared, 0.0))), float(np.sqrt(rounding))
