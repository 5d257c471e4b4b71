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
from dataclasses import dataclass, replace

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


def hinf(plant: GeneralizedPlant, *, gamma: float | None = None, tolerance: float = 1e-5) -> Synthesis:
    r"""Return a controller with the smallest H-infinity norm from w to z, or one below a given level.

    .. math:: \min_K \|T_{zw}\|_\infty = \min_K \sup_\omega \bar\sigma(T_{zw}(e^{j\omega\Delta t}))

    Parameters
    ----------
    plant : GeneralizedPlant
        Discrete, or continuous (``dt = 0``); ``D12`` of full column rank, ``D21`` of full row rank, D11 and D22
        arbitrary.
    gamma : float, optional
        Ask for this level instead of the optimum. A level well above the optimum gives a calmer controller.
    tolerance : float
        Distance of the norm from the proven bound, as a fraction of it, at which the search ends.

    Returns
    -------
    Synthesis
        ``hinf_norm`` is recomputed from the closed loop; ``lower_bound`` is the largest level that was proven to be out
        of reach of every controller, by a proof that tolerates rounding, and ``gap_percent`` the distance. The status
        is OPTIMAL when they agree within the tolerance, otherwise CERTIFIED: a better controller may exist.

    Raises
    ------
    ConfigError
        When an option is out of range.
    SynthesisError
        When an assumption fails (each is named, with the remedy), when `gamma` is out of reach, or when no controller
        survives verification.

    Examples
    --------
    >>> from kros.synthesis import GeneralizedPlant, hinf
    >>> zero, D12, D21 = [[0, 0], [0, 0]], [[0], [1.0]], [[0, 1.0]]
    >>> plant = GeneralizedPlant([[0.9]], [[1.0, 0.0]], [[1.0]], [[1.0], [0.0]], [[1.0]], zero, D12, D21, [[0]], 1.0)
    >>> optimum = hinf(plant)
    >>> optimum.status.value, bool(optimum.hinf_norm < optimum.lower_bound * 1.001)
    ('optimal', True)
    """
    if gamma is not None and not (np.isfinite(gamma) and gamma > 0):
        raise ConfigError(
            f"H-infinity synthesis: gamma should be positive, found {gamma}; leave it out for the optimum."
        )
    if not 1e-8 <= tolerance < 1:
        raise ConfigError(
            f"H-infinity synthesis: tolerance should lie in [1e-8, 1), found {tolerance}; 1e-5 is the default."
        )
    require(plant, "H-infinity synthesis", proper=False)
    start = time.perf_counter()
    idle = _closed(plant, gain(np.zeros((plant.sizes[2], plant.sizes[4])), plant.dt))
    if 0 in plant.sizes[2::2]:
        best, lower = idle, idle.norm
    else:
        frame = Frame.of(plant)
        best, lower = (_Loop(None), 0.0) if gamma is None else _attempt(frame, gamma)
        if best.norm > (gamma or 0.0):
            best, lower = _search(frame, idle, tolerance, gamma or 0.0)
    if gamma is not None and best.norm > gamma:
        raise _out_of_reach(gamma, best, lower)
    vanishes = best.norm <= _negligible(idle)
    optimal = gamma is None and (vanishes or best.norm <= lower * (1 + tolerance) * (1 + 2e-6))
    return _result(plant, best, 0.0 if vanishes else lower, optimal, time.perf_counter() - start)


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
        largest = closed.largest_pole()
        limit = 1.0 if closed.dt > 0 else 0.0
        size = 1.0 if closed.dt > 0 else float(np.abs(closed.poles()).max(initial=1.0))
        return _Loop(None) if largest >= limit - _BOUNDARY * size else _Loop(K, hinf_norm(closed))
    except (KrosError, np.linalg.LinAlgError):
        return _Loop(None)


def _negligible(idle: _Loop) -> float:
    """Return the norm below which an optimum is zero but for rounding.

    Zero where the plant is unstable without control.
    """
    return _NEGLIGIBLE * idle.norm if np.isfinite(idle.norm) else 0.0


def _search(frame: Frame, idle: _Loop, tolerance: float, wanted: float) -> tuple[_Loop, float]:
    """Return the best loop and the largest level that is proven to be out of reach.

    It ends where a wanted norm is attained.
    """
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
        if (
            best.norm <= max(wanted or lower * (1 + tolerance), low * (1 + tolerance / 4), _negligible(idle))
            or lower >= wanted > 0
        ):
            break
        # Where the bound is tight this level ends the search, with a calmer controller than that of the optimum.
        close = min(lower * (1 + 0.9 * tolerance), (lower + wanted) / 2 if wanted else np.inf)
        level = close if np.isfinite(best.norm) else 4 * level
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


def _out_of_reach(gamma: float, best: _Loop, lower: float) -> SynthesisError:
    reached = f"the best that was reached is {best.norm:.6g}, and no controller is below {lower:.6g}"
    if lower >= gamma:
        return SynthesisError(
            f"H-infinity synthesis: the level gamma = {gamma:.6g} is out of reach; {reached}. Raise gamma."
        )
    return SynthesisError(
        f"H-infinity synthesis: the level gamma = {gamma:.6g} was not reached, which does not prove that it cannot "
        f"be; {reached}. Raise gamma, or "
        "scale states, inputs and outputs to similar size."
    )


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
            "is attained; please "
            "report the plant."
        )
    lower = min(lower, best.norm)
    closed = plant.close(best.K)
    return Synthesis(
        method="hinf",
        controller=best.K,
        status=Status.OPTIMAL if optimal else Status.CERTIFIED,
        h2_norm=_h2_norm(closed),
        hinf_norm=best.norm,
        lower_bound=lower,
        gap_percent=100 * (best.norm / lower - 1) if lower > 0 else None,
        spectral_radius=closed.largest_pole(),
        solve_s=elapsed,
        solver="riccati",
    )


def _h2_controller(plant: GeneralizedPlant) -> StateSpace | None:
    """H2-optimal controller, for the first upper bound; in continuous time as if D11 were zero."""
    if plant.dt == 0:
        plant = replace(plant, D11=np.zeros_like(plant.D11))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            return h2(plant).controller
        except (SynthesisError, RuntimeWarning):
            return None


def _h2_norm(closed: StateSpace) -> float | None:
    """H2 norm; None where poles are so close to the stability boundary that it has no digits."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            return h2_norm(closed)
        except RuntimeWarning:
            return None
