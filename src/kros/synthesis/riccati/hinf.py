r"""H-infinity synthesis: one search over levels, each with a controller, a proof that it is out of reach, or both.

    plant --> frame --> level --> two Hamiltonian matrices --> central controller --> closed loop --> upper end
                          ^                 |
                          |                 +--> signals without influence of a controller ---------> lower end
                          +-------------------------------- next level <------------------------------+

What is attained is always a norm that was computed from a closed loop, what is out of reach is proven by signals on
which no controller has an influence. A level for which the equations give no controller proves nothing.

Symbols
-------
gamma : level;  K : controller
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...core.errors import ConfigError, KrosError, SynthesisError
from ...core.lti import StateSpace, gain
from ...core.norms import h2_norm, hinf_norm
from ..assumptions import h2_violations, require
from ..generalized_plant import GeneralizedPlant
from ..result import Status, Synthesis
from .h2 import h2
from .hinf_bound import level_bound, pointwise_bound
from .hinf_level import Frame, scale

_STEPS = 60
_ROUNDING = 1e-5
_NEGLIGIBLE = 1e-9  # share of the norm without control below which the optimum is zero
_BOUNDARY = 1e-9  # distance from the stability boundary, relative, that rounding decides


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
        ``hinf_norm`` is recomputed from the closed loop; ``lower_bound`` is the largest level that was proven to be out
        of reach of every controller, by a proof that tolerates rounding, and ``gap_percent`` the distance. The status
        is OPTIMAL when they agree within the tolerance, otherwise CERTIFIED: a better controller may exist.

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
    if not 1e-8 <= tolerance < 1:
        raise ConfigError(f"H-infinity synthesis: tolerance should lie in [1e-8, 1), found {tolerance}.")
    require(plant, "H-infinity synthesis", proper=False)
    start = time.perf_counter()
    idle = _closed(plant, gain(np.zeros((plant.sizes[2], plant.sizes[4])), plant.dt))
    negligible = _NEGLIGIBLE * idle.norm if np.isfinite(idle.norm) else 0.0
    trivial = 0 in plant.sizes[2::2]
    best, lower = (idle, idle.norm) if trivial else _search(Frame.of(plant), idle, tolerance, negligible)
    lower = 0.0 if best.norm <= negligible else lower
    optimal = best.norm <= max(negligible, lower * (1 + tolerance) * (1 + 2e-6))
    return _result(plant, best, lower, optimal, time.perf_counter() - start)


@dataclass(frozen=True, eq=False)
class _Loop:
    """A controller and the recomputed norm of its closed loop; infinite where there is none or it is unstable."""

    K: StateSpace | None
    norm: float = float("inf")


def _closed(plant: GeneralizedPlant, K: StateSpace | None) -> _Loop:
    """Close the loop; what a controller is worth is its norm, whatever the equations promise."""
    try:
        if K is None:
            return _Loop(None)
        closed = plant.close(K)
        limit = 1.0 if closed.dt > 0 else 0.0
        size = 1.0 if closed.dt > 0 else float(np.abs(closed.poles()).max(initial=1.0))
        stable = closed.largest_pole() < limit - _BOUNDARY * size
        return _Loop(K, hinf_norm(closed)) if stable else _Loop(None)
    except (KrosError, np.linalg.LinAlgError):
        return _Loop(None)


def _search(frame: Frame, idle: _Loop, tolerance: float, negligible: float) -> tuple[_Loop, float]:
    """Return the best loop and the largest level that is proven to be out of reach."""
    best = min(idle, _closed(frame.given, _h2_controller(frame.given)), key=lambda loop: loop.norm)
    lower = low = pointwise_bound(frame.scaled)
    level = best.norm * (1 - tolerance / 2) if np.isfinite(best.norm) else 2 * max(lower, 1e-3)
    for _ in range(_STEPS):
        trial, proven = _attempt(frame, level)
        lower = max(lower, proven)
        # A norm below what is proven to be out of reach is that of a loop whose rounding is larger than the tolerance.
        if lower <= trial.norm * (1 + _ROUNDING):
            best = min(best, trial, key=lambda loop: loop.norm)
        low = max(low, lower, level if level < (1 - tolerance) * best.norm and level * (1 + 1e-6) < trial.norm else 0.0)
        if best.norm <= max(lower * (1 + tolerance), low * (1 + tolerance / 4), negligible):
            break
        # Where the bound is tight this level ends the search, with a calmer controller than that of the optimum.
        level = lower * (1 + 0.9 * tolerance) if np.isfinite(best.norm) else 4 * level
        if low >= level:
            bottom = max(low, _NEGLIGIBLE * best.norm)
            level = float(np.sqrt(bottom * best.norm)) if best.norm > 2 * bottom else (bottom + best.norm) / 2
    return best, lower


def _attempt(frame: Frame, level: float) -> tuple[_Loop, float]:
    """Return the closed loop of the level's central controller, and what its signals prove to be out of reach."""
    try:
        halves = frame.halves(level)
    except (np.linalg.LinAlgError, ValueError):
        return _Loop(None), 0.0
    return _closed(frame.given, frame.controller(*halves, level)), level_bound(frame, halves)


def proven_bound(plant: GeneralizedPlant, level: float) -> float:
    """Return a norm that no stable loop is below, tight for a regular plant and a level just above the optimum."""
    best = pointwise_bound(scale(plant))
    if h2_violations(plant, proper=False):
        return best
    frame = Frame.of(plant)
    return max(best, level_bound(frame, frame.halves(level)))


def _result(plant: GeneralizedPlant, best: _Loop, lower: float, optimal: bool, elapsed: float) -> Synthesis:
    """Recompute the rest; the gap follows from the norm and the bound."""
    if best.K is None:
        raise SynthesisError(
            "H-infinity synthesis: no level was attained; scale states, inputs and outputs to similar size, or raise "
            "noise and penalty."
        )
    if lower > best.norm * (1 + _ROUNDING):
        raise SynthesisError(
            f"H-infinity synthesis: internal error, the bound {lower:.9g} lies above the norm {best.norm:.9g} that "
            "is attained; please report the plant."
        )
    lower = min(lower, best.norm)
    closed = plant.close(best.K)
    return Synthesis(
        method="hinf",
        controller=best.K,
        status=Status.OPTIMAL if optimal else Status.CERTIFIED,
        h2_norm=_strict(h2_norm, closed),
        hinf_norm=best.norm,
        lower_bound=lower,
        gap_percent=100 * (best.norm / lower - 1) if lower > 0 else None,
        spectral_radius=closed.largest_pole(),
        solve_s=elapsed,
        solver="riccati",
    )


def _h2_controller(plant: GeneralizedPlant) -> StateSpace | None:
    """H2-optimal controller, for the first upper bound; in continuous time as if D11 were zero."""
    direct = np.zeros_like(plant.D11) if plant.dt == 0 else plant.D11
    optimum = _strict(h2, replace(plant, D11=direct))
    return None if optimum is None else optimum.controller


def _strict(function: Callable[[Any], Any], argument: Any) -> Any:
    """Return a result; None where rounding leaves it without digits, for poles close to the stability boundary."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            return function(argument)
        except (SynthesisError, RuntimeWarning):
            return None
