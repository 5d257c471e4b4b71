r"""Mixed H2/H-infinity synthesis (7)-(8): ``min ||T11||_2`` subject to ``||T22||_inf < gamma``, every number recomputed.

    H2 optimum without the constraint --(constraint met)--> optimal
        |
        v
    is gamma within reach of any controller? --(no)--> error with the least norm of T22
        |
        v
    matrix inequalities, several scalings of channel 2                       -->  candidates
    H-infinity controllers of both channels together                         -->  candidates
        |
        v
    verification on the full plant --> local improvement --> verification --> lower bound and gap

The inequalities with one Lyapunov matrix for both channels bound ``||T11||_2`` from above, often by far. Scaling the second channel
(``w2 -> a w2``, ``z2 -> z2 / a``) leaves the problem as it is and changes that bound. The unscaled
inequalities are always among the candidates, so that nothing is ever worse than they are.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from ...core.errors import ConfigError, SynthesisError
from ...core.norms import hinf_norm
from ..assumptions import require, require_plant
from ..generalized_plant import GeneralizedPlant
from ..problem.observer_problem import ObserverProblem
from ..result import Status, Synthesis
from ..riccati.h2_optimal import h2
from .attainable import require_attainable, require_reachable
from .balance import in_balance, reached
from .candidates import by_hinf, by_inequalities
from .channels import Verified, part, verify
from .continuous import continuous_controller, discrete_twin, speed
from .improvement import polish
from .lower_bounds import mixed_lower_bound
from .singular import is_degenerate, is_singular, on_the_plant, regularised
from .solvers import QUICK

_SCALINGS = (1.0, 4.0, 16.0)
_LAST_SCALINGS = (64.0, 256.0)
_POLISHED = 2


def mixed(
    plant: GeneralizedPlant | ObserverProblem,
    *,
    gamma: float = 1.0,
    scalings: Sequence[float] | None = None,
    max_states: int = 8,
    time_limit_s: float = 20.0,
) -> Synthesis:
    """Return a controller with a small H2 norm in channel 1 and an H-infinity norm below `gamma` in channel 2.

    Parameters
    ----------
    plant : GeneralizedPlant or ObserverProblem
        A plant with its channel partition (`n_w1`, `n_z1`), with penalty and noise in channel 1 (a discrete one may lack them, see
        `kros.synthesis.mixed_norms.singular`); or an observer problem, whose reduced and regularised plant is then used, and whose result is a
        filter in physical units with a certified ``worst_case_h2``. Continuous plants are mapped to discrete time, exactly.
    gamma : float
        Level of the H-infinity constraint.
    scalings : sequence of float
        Scalings of the second channel to try; the best verified result is kept. Default 1, 4, 16, and larger ones where these fail. For
        observer problems see `kros.synthesis.mixed_norms.observer`.
    max_states : int
        Stable plants are reduced to this number by balanced truncation for the inequalities only (their cost grows with the sixth power of
        the states, and states of no consequence make them ill-conditioned). The controller is verified on the full plant.
    time_limit_s : float
        For the whole search; what was found by then is returned.

    Returns
    -------
    Synthesis
        ``h2_norm`` of T11 and ``hinf_norm`` of T22 recomputed on the full plant; ``lower_bound`` holds for every controller of any order.

    Raises
    ------
    ConfigError
        When an option is out of range.
    SynthesisError
        When the plant is not regular, when gamma is shown to be out of reach (with the least that is not), or when no controller survives
        verification (each reason is given).

    Examples
    --------
    >>> import numpy as np
    >>> from kros.synthesis import GeneralizedPlant, mixed
    >>> D11, D12 = np.zeros((3, 3)), [[0.0], [1.0], [0.0]]
    >>> plant = GeneralizedPlant([[0.9]], [[1.0, 0, 0.1]], [[1.0]], [[1.0], [0], [0.5]], [[1.0]], D11, D12, [[0, 1.0, 0]], [[0.0]], 1.0, 2, 2)
    >>> mixed(plant).hinf_norm < 1
    True
    """
    tried = _SCALINGS if scalings is None else tuple(scalings)
    if gamma <= 0 or not tried or min(tried) <= 0 or time_limit_s <= 0 or max_states < 1:
        raise ConfigError(
            f"Mixed synthesis: gamma = {gamma}, scalings = {tried}, time_limit_s = {time_limit_s}, max_states = {max_states} should all be positive."
        )
    if isinstance(plant, ObserverProblem):
        from .observer import for_observer

        return for_observer(plant, gamma, scalings, max_states, time_limit_s)
    require_plant(plant, "Mixed synthesis")
    if not plant.sizes[0]:
        raise SynthesisError(
            "Mixed synthesis needs a plant with states, found none; without dynamics the best gain is a small convex problem."
        )
    if plant.dt == 0:
        return _continuous(plant, gamma, scalings=scalings, max_states=max_states, time_limit_s=time_limit_s)
    start = time.perf_counter()
    end = start + time_limit_s
    if is_singular(plant):
        return _singular(plant, gamma, tried, max_states, start, end)
    free = h2(performance(plant))
    unconstrained = verify(plant, free.controller, gamma, "H2 optimum without the constraint", "riccati")
    if isinstance(unconstrained, Verified):
        note = "The H2 optimum meets the constraint: it is the optimum of the mixed problem."
        return _synthesis(unconstrained, free.lower_bound, Status.OPTIMAL, [note], start)
    require_attainable(plant, gamma, hinf_norm(part(plant, plant.close(free.controller), 2)), time_limit_s / 10)
    notes: list[str] = []
    reasons: list[str] = []
    found = by_inequalities(plant, gamma, tried, max_states, end, reasons, notes, QUICK)
    found += by_hinf(plant, gamma, end, reasons)
    if not found:
        easier = reached(plant)
        if easier is not plant:  # the inequalities have not been tried yet
            found = on_the_plant(
                plant, by_inequalities(easier, gamma, (*tried, *_LAST_SCALINGS), max_states, end, reasons, notes, QUICK), gamma
            )
        else:
            found = by_inequalities(plant, gamma, _LAST_SCALINGS if scalings is None else tried, max_states, end, reasons, notes)
    if not found:
        why = "; ".join(dict.fromkeys(reasons)) or "nothing could be tried"
        raise SynthesisError(
            f"Mixed synthesis: no controller survived; {why}. Raise gamma = {gamma:g}, max_states, noise or the time limit."
        )
    found += _improved(plant, found, gamma, end)
    best = min(found, key=lambda v: v.h2)
    lower = free.lower_bound or 0.0
    if best.h2 > 1.01 * lower and time.perf_counter() < end:
        lower = max(lower, mixed_lower_bound(plant, gamma, best.h2, time_limit_s=min(end - time.perf_counter(), 3.0)))
    notes.append(f"Found by: {best.origin}.")
    return _synthesis(best, lower, Status.CERTIFIED if best.optimal else Status.INACCURATE, notes, start)


def _singular(
    plant: GeneralizedPlant,
    gamma: float,
    scalings: Sequence[float],
    max_states: int,
    start: float,
    end: float,
) -> Synthesis:
    """Solve a plant without penalty or noise in channel 1; there is no lower bound but for a degenerate one."""
    require_reachable(plant, gamma)
    regular, degenerate = regularised(plant), is_degenerate(plant)
    notes: list[str] = []
    reasons: list[str] = []
    for tried in [(a,) for a in (*scalings, *_LAST_SCALINGS)] if degenerate else [tuple(scalings)]:
        found = by_inequalities(regular, gamma, tried, max_states, end, reasons, notes)
        found = on_the_plant(plant, found, gamma)
        if found:
            break
    if not degenerate or not found:
        found += on_the_plant(plant, by_hinf(regular, gamma, end, reasons), gamma)
    if not found:
        require_attainable(regular, gamma, 2 * gamma, max(end - time.perf_counter(), 1.0))
        why = "; ".join(dict.fromkeys(reasons)) or "nothing could be tried"
        raise SynthesisError(
            f"Mixed synthesis of a singular plant: no controller survived; {why}. Add penalty and noise to channel 1, or raise gamma."
        )
    if degenerate:
        notes.append(
            "T11 is the same for every controller, so each that meets the constraint is optimal; this one is that of the inequalities."
        )
    else:
        found += _improved(plant, found, gamma, end)
    best = min(found, key=lambda v: v.h2)
    notes.append(
        "Channel 1 has no control penalty or no measurement noise; small ones were added for the search, the norms are of the plant as given."
    )
    notes.append(f"Found by: {best.origin}.")
    lower = best.h2 if degenerate else None
    return _synthesis(best, lower, Status.CERTIFIED if best.optimal else Status.INACCURATE, list(dict.fromkeys(notes)), start)


def _continuous(plant: GeneralizedPlant, gamma: float, **options: Any) -> Synthesis:
    """Solve the discrete twin of a continuous plant, and verify on the plant itself."""
    require(performance(plant), "Mixed synthesis in continuous time")
    require_reachable(plant, gamma)
    a = speed(plant)
    found = mixed(discrete_twin(plant, a), gamma=gamma, **options)
    verdict = verify(plant, continuous_controller(found.controller, a), gamma, "the controller of the discrete twin", found.solver)
    if not isinstance(verdict, Verified):
        raise SynthesisError(f"Mixed synthesis in continuous time: {verdict}; scale states to similar size, or raise gamma.")
    return replace(
        found,
        controller=verdict.controller,
        h2_norm=verdict.h2,
        hinf_norm=verdict.hinf,
        lower_bound=None if found.lower_bound is None else min(found.lower_bound, verdict.h2),
        spectral_radius=verdict.margin,
        notes=(
            *found.notes,
            f"Solved in discrete time by the bilinear map at {a:.6g} rad/s, which is exact; the norms are of the continuous loop.",
        ),
    )


def performance(plant: GeneralizedPlant) -> GeneralizedPlant:
    """Return the plant of channel 1 alone."""
    return plant.channel(plant.rows(1), plant.columns(1))


def _improved(plant: GeneralizedPlant, found: list[Verified], gamma: float, end: float) -> list[Verified]:
    """Best candidates after local improvement."""
    better = []
    for v in sorted(found, key=lambda v: v.h2)[:_POLISHED]:
        left = end - time.perf_counter()
        if left <= 0:
            break
        polished = in_balance(plant, v.controller, partial(polish, gamma=gamma, time_limit_s=left / 2))
        verdict = verify(plant, polished, gamma, f"{v.origin}; then local improvement", v.solver, v.optimal)
        if isinstance(verdict, Verified):
            better.append(verdict)
    return better


def _synthesis(best: Verified, lower: float | None, status: Status, notes: list[str], start: float) -> Synthesis:
    useful = lower is not None and lower > 1e-9 * best.h2
    bound = min(lower, best.h2) if lower is not None else None
    return Synthesis(
        method="mixed",
        controller=best.controller,
        status=status,
        h2_norm=best.h2,
        hinf_norm=best.hinf,
        lower_bound=bound,
        gap_percent=100 * (best.h2 / bound - 1) if useful and bound else None,
        spectral_radius=best.margin,
        solve_s=time.perf_counter() - start,
        solver=best.solver,
        notes=tuple(notes),
    )
