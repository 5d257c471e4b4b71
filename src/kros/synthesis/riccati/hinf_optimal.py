r"""H-infinity synthesis: controllers of levels by two Riccati equations (`hinf_central`), and a proof of what is out of reach (`hinf_bound`).

    plant --> coordinates --> first controllers --> proven bound --> levels above it --> central controllers --> closed loop, norm recomputed

What is attained is always a norm that was computed from a closed loop, what is out of reach is proven by signals on which no controller has an
influence. A level for which the equations give no controller proves nothing.

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
from ..assumptions import require
from ..generalized_plant import GeneralizedPlant
from ..result import Status, Synthesis
from .h2_optimal import h2, stability_margin
from .hinf_bound import proven_bound
from .hinf_central import central
from .hinf_coordinates import Coordinates, coordinates
from .hinf_pointwise import direct_bound

_MAX_STEPS = 60
_MAX_RAISES = 40
_NEGLIGIBLE = 1e-9
_ROUNDING = 1e-5
_COARSE = 1e-3
_BOUNDARY = 1e-10


def hinf(plant: GeneralizedPlant, *, gamma: float | None = None, tolerance: float = 1e-5) -> Synthesis:
    r"""Return a controller with the smallest H-infinity norm from w to z, or one below a given level.

    .. math:: \min_K \|T_{zw}\|_\infty = \min_K \sup_\omega \bar\sigma(T_{zw}(e^{j\omega\Delta t}))

    Parameters
    ----------
    plant : GeneralizedPlant
        Discrete, or continuous (``dt = 0``); ``D12`` of full column rank, ``D21`` of full row rank, D11 and D22 arbitrary.
    gamma : float, optional
        Ask for this level instead of the optimum. A level well above the optimum gives a calmer controller.
    tolerance : float
        Distance of the norm from the proven bound, as a fraction of it, at which the search ends.

    Returns
    -------
    Synthesis
        ``hinf_norm`` is recomputed from the closed loop; ``lower_bound`` is the largest level that was proven to be out of reach of every
        controller, by a proof that tolerates rounding, and ``gap_percent`` the distance. The status is OPTIMAL when they agree within the tolerance,
        otherwise CERTIFIED: a better controller may exist.

    Raises
    ------
    ConfigError
        When an option is out of range.
    SynthesisError
        When an assumption fails (each is named, with the remedy), when `gamma` is out of reach, or when no controller survives verification.

    Examples
    --------
    >>> from kros.synthesis import GeneralizedPlant, hinf
    >>> plant = GeneralizedPlant([[0.9]], [[1.0, 0.0]], [[1.0]], [[1.0], [0.0]], [[1.0]], [[0, 0], [0, 0]], [[0], [1.0]], [[0, 1.0]], [[0]], 1.0)
    >>> found = hinf(plant)
    >>> found.status.value, bool(found.hinf_norm < found.lower_bound * 1.001)
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
    if 0 in plant.sizes[2::2]:
        return _without_control(plant, gamma)
    if gamma is not None:
        (best, lower), vanishes = _at(plant, gamma), False
    else:
        best, lower, vanishes = _optimum(plant, coordinates(plant), tolerance)
    elapsed = time.perf_counter() - start
    optimal = gamma is None and (vanishes or best.norm <= lower * (1 + tolerance) * (1 + 2e-6))
    return _result(plant, best, 0.0 if vanishes else lower, optimal, elapsed)


@dataclass(frozen=True, eq=False)
class _Loop:
    """A controller and the recomputed norm of its closed loop; infinite where there is none or it is unstable."""

    K: StateSpace | None
    norm: float = float("inf")


def _closed(plant: GeneralizedPlant, K: StateSpace | None) -> _Loop:
    """Close the loop; what a controller is worth is its norm, whatever the equations promise."""
    try:
        if K is None or _on_the_boundary(plant.close(K)):
            return _Loop(None)
        return _Loop(K, hinf_norm(plant.close(K)))
    except (KrosError, np.linalg.LinAlgError):
        return _Loop(None)


def _on_the_boundary(closed: StateSpace) -> bool:
    """Whether a pole is within rounding of the stability boundary, or beyond it."""
    poles = closed.poles()
    if closed.dt > 0:
        return bool(np.abs(poles).max(initial=0.0) >= 1 - _BOUNDARY)
    return bool(poles.real.max(initial=-1.0) >= -_BOUNDARY * np.abs(poles).max(initial=1.0))


def _level(plant: GeneralizedPlant, frame: Coordinates, gamma: float) -> _Loop:
    """Try one level."""
    K = central(frame.plant, gamma)
    try:
        return _closed(plant, None if K is None else frame.controller(K))
    except SynthesisError:
        return _Loop(None)


def _first(plant: GeneralizedPlant, frame: Coordinates) -> _Loop:
    """Any stable loop: without control, of the H2 optimum, else of a level that is raised until there is one."""
    best = min((_idle(plant), _closed(plant, _h2_controller(plant))), key=lambda loop: loop.norm)
    gamma = 2 * max(direct_bound(plant), float(np.linalg.norm(plant.D11)), 1e-3)
    for _ in range(_MAX_RAISES):
        if np.isfinite(best.norm):
            return best
        best = _level(plant, frame, gamma)
        gamma *= 4
    raise SynthesisError(
        f"H-infinity synthesis: no level up to {gamma:.3g} was attained; scale states, inputs and outputs to similar size, "
        "or raise noise and penalty."
    )


def _idle(plant: GeneralizedPlant) -> _Loop:
    """Close the loop without control."""
    return _closed(plant, gain(np.zeros((plant.sizes[2], plant.sizes[4])), plant.dt))


def _optimum(plant: GeneralizedPlant, frame: Coordinates, tolerance: float) -> tuple[_Loop, float, bool]:
    """Bisect between the proven bound and the best norm; the last value tells whether the optimum is zero."""
    idle, best = _idle(plant), _first(plant, frame)
    floor = _NEGLIGIBLE * (idle.norm if np.isfinite(idle.norm) else best.norm)
    low = lower = proven_bound(plant, best.norm, tolerance)
    if idle.norm <= lower * (1 + tolerance):
        return idle, lower, False
    middle = lower * (
        1 + 0.9 * tolerance
    )  # where the bound is tight this is the end, and a calmer controller than that of the optimum
    for _ in range(_MAX_STEPS):
        trial = _level(plant, frame, middle)
        best = min((best, trial), key=lambda loop: loop.norm)
        if trial.norm > middle * (1 + 1e-6):
            low = middle
        if best.norm <= max(low * (1 + tolerance / 4), lower * (1 + tolerance), floor):
            break
        bottom = max(low, floor)
        middle = float(np.sqrt(bottom * best.norm)) if best.norm > 2 * bottom else (bottom + best.norm) / 2
    if best.norm > lower * (1 + tolerance):
        lower = max(lower, proven_bound(plant, best.norm, tolerance))
    return best, lower, best.norm <= floor


def _at(plant: GeneralizedPlant, gamma: float) -> tuple[_Loop, float]:
    """Controller for a level that was asked for, and the proven bound."""
    frame = coordinates(plant)
    for margin in (0.0, 1e-7, 1e-6, 1e-5):
        loop = _level(plant, frame, gamma * (1 - margin))
        if loop.norm <= gamma:
            return loop, proven_bound(plant, loop.norm, _COARSE)
    best, lower, _ = _optimum(plant, frame, _COARSE)
    if best.norm <= gamma:
        return best, lower
    reached = f"the best that was reached is {best.norm:.6g}, and no controller is below {lower:.6g}"
    if lower >= gamma:
        raise SynthesisError(
            f"H-infinity synthesis: the level gamma = {gamma:.6g} is out of reach; {reached}. Raise gamma."
        )
    raise SynthesisError(
        f"H-infinity synthesis: the level gamma = {gamma:.6g} was not reached, which does not prove that it cannot be; {reached}. Raise gamma, or scale "
        "states, inputs and outputs to similar size."
    )


def _result(plant: GeneralizedPlant, best: _Loop, lower: float, optimal: bool, elapsed: float) -> Synthesis:
    """Recompute the rest; the gap follows from the norm and the bound."""
    K, norm = best.K, best.norm
    assert K is not None
    if lower > norm * (1 + _ROUNDING):
        raise SynthesisError(
            f"H-infinity synthesis: internal error, the bound {lower:.9g} lies above the norm {norm:.9g} that is attained; please report the plant."
        )
    lower = min(lower, norm)
    closed = plant.close(K)
    return Synthesis(
        method="hinf",
        controller=K,
        status=Status.OPTIMAL if optimal else Status.CERTIFIED,
        h2_norm=_h2_norm(closed),
        hinf_norm=norm,
        lower_bound=lower,
        gap_percent=100 * (norm / lower - 1) if lower > 0 else None,
        spectral_radius=stability_margin(closed),
        solve_s=elapsed,
        solver="riccati",
    )


def _without_control(plant: GeneralizedPlant, gamma: float | None) -> Synthesis:
    """Nothing to choose: no control, or no measurement; by then the plant is known to be stable."""
    open_loop = StateSpace(plant.A, plant.B1, plant.C1, plant.D11, plant.dt)
    norm = hinf_norm(open_loop)
    if gamma is not None and norm > gamma:
        raise SynthesisError(
            f"H-infinity synthesis: without controls or measurements the norm is {norm:.6g}, above gamma = {gamma:.6g}."
        )
    return Synthesis(
        method="hinf",
        controller=gain(np.zeros((plant.sizes[2], plant.sizes[4])), plant.dt),
        status=Status.OPTIMAL,
        h2_norm=_h2_norm(open_loop),
        hinf_norm=norm,
        lower_bound=norm,
        gap_percent=0.0,
        spectral_radius=stability_margin(open_loop),
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
