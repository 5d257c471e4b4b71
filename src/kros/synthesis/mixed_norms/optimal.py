r"""Mixed H2/H-infinity synthesis (7)-(8): ``min ||T11||_2`` subject to ``||T22||_inf < gamma``.

    H2 optimum without the constraint --(constraint met)--> optimal
        |
        v
    is gamma proven out of reach? --(yes)--> error with the least norm of T22
        |
        v
    matrix inequalities, several scalings of channel 2 --> controllers, verified on the full plant
        |
        v
    local improvement --> verification --> lower bound and gap

The inequalities with one Lyapunov matrix for both channels bound ``||T11||_2`` from above, often by far. Scaling the
second channel (``w2 -> a w2``, ``z2 -> z2 / a``) leaves the problem as it is and changes that bound. The unscaled
inequalities are always among the candidates, so that nothing is ever worse than they are.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from ...core.errors import ConfigError, SynthesisError
from ...core.norms import hinf_norm
from ..assumptions import require, require_plant
from ..generalized_plant import GeneralizedPlant
from ..problem.observer_problem import ObserverProblem
from ..result import Synthesis
from ..riccati.equations import absorb_feedthrough
from ..riccati.h2 import h2
from ..riccati.hinf import proven_bound
from .candidates import by_inequalities, infeasible, verify
from .improvement import improved
from .inequalities import balance
from .lower_bounds import mixed_lower_bound
from .observer import for_observer

_SCALINGS = (1.0, 4.0, 16.0)
_IMPROVED = 2  # candidates that are improved


def mixed(
    plant: GeneralizedPlant | ObserverProblem, *, gamma: float = 1.0, max_states: int = 8, time_limit_s: float = 20.0
) -> Synthesis:
    """Return a controller with a small H2 norm in channel 1 and an H-infinity norm below `gamma` in channel 2.

    Parameters
    ----------
    plant : GeneralizedPlant or ObserverProblem
        A discrete plant with its channel partition (`n_w1`, `n_z1`), with penalty and noise in channel 1; or an
        observer problem, whose reduced and regularised plant is then used, and whose result is a filter in physical
        units with a certified ``worst_case_h2``.
    gamma : float
        Level of the H-infinity constraint.
    max_states : int
        Stable plants are reduced to this number by balanced truncation for the inequalities only (their cost grows with
        the sixth power of the states, and states of no consequence make them ill-conditioned). The controller is
        verified on the full plant.
    time_limit_s : float, s
        For the whole search; what was found by then is returned.

    Returns
    -------
    Synthesis
        ``h2_norm`` of T11 and ``hinf_norm`` of T22 recomputed on the full plant; ``lower_bound`` holds for every
        controller of any order.

    Raises
    ------
    ConfigError
        When an option is out of range.
    SynthesisError
        When the plant is not regular, when gamma is shown to be out of reach (with the least that is not), or when no
        controller survives verification (each reason is given).

    Examples
    --------
    >>> import numpy as np
    >>> from kros.synthesis import GeneralizedPlant, mixed
    >>> B1, C1, D11 = [[1.0, 0, 0.1]], [[1.0], [0], [0.5]], np.zeros((3, 3))
    >>> D12, D21 = [[0.0], [1.0], [0.0]], [[0, 1.0, 0]]
    >>> plant = GeneralizedPlant([[0.9]], B1, [[1.0]], C1, [[1.0]], D11, D12, D21, [[0.0]], 1.0, n_w1=2, n_z1=2)
    >>> mixed(plant).hinf_norm < 1
    True
    """
    if gamma <= 0 or time_limit_s <= 0 or max_states < 1:
        raise ConfigError(
            f"Mixed synthesis: gamma = {gamma}, time_limit_s = {time_limit_s}, max_states = {max_states} should all "
            "be positive."
        )
    if isinstance(plant, ObserverProblem):
        return for_observer(plant, gamma, max_states, time_limit_s)
    start = time.perf_counter()
    free = _unconstrained(plant)
    if free.hinf_norm is not None and free.hinf_norm < gamma:
        note = "The H2 optimum meets the constraint: it is the optimum of the mixed problem."
        return _stated(free, free.lower_bound or 0.0, start, note)
    require_reachable(plant, gamma, free.hinf_norm or 0.0)
    bare, end = replace(plant, D22=np.zeros_like(plant.D22)), start + time_limit_s
    candidates = by_inequalities(bare, gamma, _SCALINGS, max_states, end)
    candidates += _improved(bare, candidates, gamma, end)
    best = min(candidates, key=_cost)
    lower = free.lower_bound or 0.0
    if _cost(best) > 1.01 * lower and time.perf_counter() < end:
        lower = max(lower, mixed_lower_bound(bare, gamma, _cost(best), min(end - time.perf_counter(), 3.0)))
    best = replace(best, controller=absorb_feedthrough(best.controller, plant.D22))
    return _stated(best, lower, start, *best.notes)


def _unconstrained(plant: GeneralizedPlant) -> Synthesis:
    """Return the H2 optimum of channel 1 with its norm in channel 2."""
    require_plant(plant, "Mixed synthesis")
    if plant.dt == 0:
        raise SynthesisError("Mixed synthesis works in discrete time, found a continuous plant (dt = 0); sample it.")
    if not plant.sizes[0]:
        raise SynthesisError(
            "Mixed synthesis needs a plant with states, found none; without dynamics the best gain is a small convex "
            "problem."
        )
    require(plant.performance, "Mixed synthesis")
    free = h2(plant.performance)
    return replace(free, method="mixed", hinf_norm=hinf_norm(plant.uncertainty.close(free.controller)))


def _cost(candidate: Synthesis) -> float:
    return np.inf if candidate.h2_norm is None else candidate.h2_norm


def _stated(best: Synthesis, lower: float, start: float, *notes: str) -> Synthesis:
    """Return the best controller with its bound."""
    value = _cost(best)
    lower = min(lower, value)
    gap = 100 * (value / lower - 1) if lower > 1e-9 * value else None
    solve_s = time.perf_counter() - start
    return replace(best, lower_bound=lower, gap_percent=gap, solve_s=solve_s, notes=tuple(dict.fromkeys(notes)))


def require_reachable(plant: GeneralizedPlant, gamma: float, attained: float) -> None:
    """Raise a `SynthesisError` when the proven bound of ||T22|| shows that no controller attains the level."""
    two = plant.uncertainty
    least = proven_bound(two, max(attained, 2 * gamma)) if two.D11.size else 0.0
    if least >= gamma:
        raise infeasible(gamma, least)


def _improved(plant: GeneralizedPlant, candidates: list[Synthesis], gamma: float, end: float) -> list[Synthesis]:
    """Best candidates after local improvement in balanced coordinates."""
    balanced, better = balance(plant), []
    for candidate in sorted(candidates, key=_cost)[:_IMPROVED]:
        left = end - time.perf_counter()
        if left <= 0:
            break
        K = balanced.controller(improved(balanced.plant, balanced.inside(candidate.controller), gamma, left / 2))
        try:
            note = f"{candidate.notes[-1][:-1]}; then local improvement"
            result = verify(plant, K, gamma, note)
            better.append(replace(result, status=candidate.status, notes=(*candidate.notes[:-1], *result.notes)))
        except SynthesisError:
            continue
    return better
