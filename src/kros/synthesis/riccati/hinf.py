r"""H-infinity synthesis: one search over levels, each with a controller or the condition that fails.

    plant --> frame --> level --> two Riccati equations --> central controller --> closed loop --> upper end
                          ^                 |
                          |                 +--> conditions clearly fail ---------------------------> lower end
                          +----------------------------- next level <---------------------------------+

What is attained is always a norm that was computed from a closed loop. Out of reach is what signals of one frequency
prove (`parrott`), or a level whose necessary conditions fail by more than rounding. A level for which the equations
have no solution proves nothing.

Symbols
-------
gamma : level;  K : controller
"""

from __future__ import annotations

import time
import warnings

import numpy as np

from ...core.arrays import frozen
from ...core.errors import ConfigError, KrosError, SynthesisError
from ...core.lti import StateSpace, gain
from ...core.norms import h2_norm, hinf_norm
from ...core.rounding import AGREED, ITERATED
from ..assumptions import require
from ..generalized_plant import GeneralizedPlant
from ..result import Status, Synthesis, enclosed
from .hinf_level import Frame
from .parrott import frequency_bound


def hinf(plant: GeneralizedPlant, *, tolerance: float = 1e-5) -> Synthesis:
    r"""Return a controller with the smallest H-infinity norm from w to z.

    .. math:: \min_K \|T_{zw}\|_\infty = \min_K \sup_\omega \bar\sigma(T_{zw}(e^{j\omega\Delta t}))

    Parameters
    ----------
    plant : GeneralizedPlant
        Discrete, or continuous (``dt = 0``); ``D12`` of full column rank, ``D21`` of full row rank, D11 and D22
        arbitrary.
    tolerance : float
        Distance of the norm from the proven bound, as a fraction of it, at which the search ends. Some percent give a
        calmer controller than the optimum.

    Returns
    -------
    Synthesis
        ``hinf_norm`` is recomputed from the closed loop; ``lower_bound`` is the largest level whose necessary
        conditions fail by more than rounding, and ``gap_percent`` the distance. The status is OPTIMAL when they agree
        within the tolerance, otherwise CERTIFIED: a better controller may exist.

    Raises
    ------
    ConfigError
        When the tolerance is out of range.
    SynthesisError
        When an assumption fails (each is named, with the remedy), or when no controller survives verification.

    Examples
    --------
    >>> from kros.synthesis import GeneralizedPlant, hinf
    >>> zero, D12, D21 = [[0, 0], [0, 0]], [[0], [1.0]], [[0, 1.0]]
    >>> plant = GeneralizedPlant([[0.9]], [[1.0, 0.0]], [[1.0]], [[1.0], [0.0]], [[1.0]], zero, D12, D21, [[0]], 1.0)
    >>> optimum = hinf(plant)
    >>> optimum.status.value, bool(optimum.hinf_norm < optimum.lower_bound * 1.001)
    ('optimal', True)
    """
    if not ITERATED <= tolerance < 1:
        raise ConfigError(f"H-infinity synthesis: tolerance should lie in [1e-9, 1), found {tolerance}.")
    require(plant, "H-infinity synthesis", proper=False)
    start = time.perf_counter()
    idle = _closed(plant, gain(np.zeros((plant.sizes[2], plant.sizes[4])), plant.dt))
    negligible = ITERATED * idle.norm if np.isfinite(idle.norm) else 0.0
    trivial = 0 in plant.sizes[2::2]
    best, lower = (idle, idle.norm) if trivial else _search(Frame.of(plant), idle, tolerance, negligible)
    lower = 0.0 if best.norm <= negligible else lower
    optimal = best.norm <= max(negligible, lower * (1 + tolerance) * (1 + 2 * AGREED))
    return _result(plant, best, lower, optimal, time.perf_counter() - start)


@frozen
class _Loop:
    """A controller and the recomputed norm of its closed loop; infinite where there is none or it is unstable."""

    K: StateSpace | None
    norm: float = float("inf")


def _closed(plant: GeneralizedPlant, K: StateSpace | None) -> _Loop:
    """Close the loop; what a controller is worth is its norm, whatever the equations promise."""
    if K is None:
        return _Loop(None)
    try:
        closed = plant.close(K)
        limit, size = (1.0, 1.0) if closed.dt > 0 else (0.0, float(np.abs(closed.poles()).max(initial=1.0)))
        return _Loop(K, hinf_norm(closed)) if closed.largest_pole() < limit - ITERATED * size else _Loop(None)
    except (KrosError, np.linalg.LinAlgError):
        return _Loop(None)


def _search(frame: Frame, idle: _Loop, tolerance: float, negligible: float) -> tuple[_Loop, float]:
    """Return the best loop and the largest level that is out of reach, by bisection of the levels between them."""
    best, proven = idle, frequency_bound(frame.scaled)
    lower = low = proven
    level, high = max(2 * proven, 1.0), best.norm
    for _ in range(60):  # bisections, at most
        if best.norm <= max(lower * (1 + tolerance), negligible) or high <= low * (1 + tolerance / 8):
            break
        if np.isfinite(high):
            level = float(np.sqrt(max(low, ITERATED * high) * high))
        K, failed = frame.solve(level)
        trial = _closed(frame.given, K)
        best = min(best, trial, key=lambda loop: loop.norm)
        low, high = (low, min(best.norm, level)) if np.isfinite(trial.norm) else (level, min(high, best.norm))
        lower = level if failed else lower
        level *= 4
    return best, lower if lower <= best.norm else proven  # rounding had its say where levels and norms disagree


def _result(plant: GeneralizedPlant, best: _Loop, lower: float, optimal: bool, elapsed: float) -> Synthesis:
    """Recompute the rest; the gap follows from the norm and the bound."""
    if best.K is None:
        remedy = "scale states, inputs and outputs to similar size, or raise noise and penalty"
        raise SynthesisError(f"H-infinity synthesis: no level was attained; {remedy}.")
    lower_bound, gap, notes = enclosed(best.norm, lower)
    closed = plant.close(best.K)
    return Synthesis(
        method="hinf",
        controller=best.K,
        status=Status.OPTIMAL if optimal else Status.CERTIFIED,
        h2_norm=_h2_norm(closed),
        hinf_norm=best.norm,
        lower_bound=lower_bound,
        gap_percent=gap,
        spectral_radius=closed.largest_pole(),
        solve_s=elapsed,
        solver="riccati",
        notes=notes,
    )


def _h2_norm(closed: StateSpace) -> float | None:
    """Return the H2 norm; None where rounding leaves it without digits, for poles close to the stability boundary."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            return h2_norm(closed)
        except RuntimeWarning:
            return None
