r"""Mixed H2/H-infinity synthesis (7)-(8): ``min ||T11||_2`` subject to ``||T22||_inf < gamma``, every number recomputed.

    H2 optimum without the constraint --(constraint met)--> optimal
        |
        v
    is gamma proven out of reach? --(yes)--> error with the least norm of T22
        |
        v
    matrix inequalities, several scalings of channel 2 --> candidates, verified on the full plant
        |
        v
    local improvement --> verification --> lower bound and gap

The inequalities with one Lyapunov matrix for both channels bound ``||T11||_2`` from above, often by far. Scaling the second channel
(``w2 -> a w2``, ``z2 -> z2 / a``) leaves the problem as it is and changes that bound. The unscaled
inequalities are always among the candidates, so that nothing is ever worse than they are.
"""

from __future__ import annotations

import time

from ...core.errors import ConfigError, SynthesisError
from ...core.norms import hinf_norm
from ..assumptions import require_plant
from ..generalized_plant import GeneralizedPlant
from ..problem.observer_problem import ObserverProblem
from ..result import Status, Synthesis
from ..riccati.equations import absorb_feedthrough
from ..riccati.h2 import h2
from .balance import balance, reached
from .candidates import by_inequalities
from .channels import Verified, part, require_reachable, verify
from .improvement import improved
from .lower_bounds import mixed_lower_bound
from .singular import is_singular, regularised

_SCALINGS = (1.0, 4.0, 16.0)
_POLISHED = 2


def mixed(
    plant: GeneralizedPlant | ObserverProblem,
    *,
    gamma: float = 1.0,
    max_states: int = 8,
    time_limit_s: float = 20.0,
) -> Synthesis:
    """Return a controller with a small H2 norm in channel 1 and an H-infinity norm below `gamma` in channel 2.

    Parameters
    ----------
    plant : GeneralizedPlant or ObserverProblem
        A discrete plant with its channel partition (`n_w1`, `n_z1`), with penalty and noise in channel 1 (without them, as in the published
        plant (37)-(39), small ones are added for the search, and there is no lower bound); or an observer problem, whose reduced and
        regularised plant is then used, and whose result is a filter in physical units with a certified ``worst_case_h2``.
    gamma : float
        Level of the H-infinity constraint.
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
    if gamma <= 0 or time_limit_s <= 0 or max_states < 1:
        raise ConfigError(
            f"Mixed synthesis: gamma = {gamma}, time_limit_s = {time_limit_s}, max_states = {max_states} should all be positive."
        )
    if isinstance(plant, ObserverProblem):
        from .observer import for_observer

        return for_observer(plant, gamma, max_states, time_limit_s)
    require_plant(plant, "Mixed synthesis")
    if not plant.sizes[0]:
        raise SynthesisError(
            "Mixed synthesis needs a plant with states, found none; without dynamics the best gain is a small convex problem."
        )
    if plant.dt == 0:
        raise SynthesisError("Mixed synthesis works in discrete time, found a continuous plant (dt = 0); sample it.")
    start = time.perf_counter()
    end = start + time_limit_s
    if is_singular(plant):
        return _singular(plant, gamma, max_states, start, end)
    free = h2(performance(plant))
    unconstrained = verify(plant, free.controller, gamma, "H2 optimum without the constraint")
    if isinstance(unconstrained, Verified):
        note = "The H2 optimum meets the constraint: it is the optimum of the mixed problem."
        return _synthesis(unconstrained, "riccati", free.lower_bound, Status.OPTIMAL, [note], start)
    require_reachable(plant, gamma, hinf_norm(part(plant, plant.close(free.controller), 2)))
    notes: list[str] = []
    reasons: list[str] = []
    found = by_inequalities(plant, gamma, _SCALINGS, max_states, end, reasons, notes)
    if not found:
        raise _nothing_found(gamma, reasons)
    found += _improved(plant, found, gamma, end)
    best = min(found, key=lambda v: v.h2)
    lower = free.lower_bound or 0.0
    if best.h2 > 1.01 * lower and time.perf_counter() < end:
        lower = max(lower, mixed_lower_bound(plant, gamma, best.h2, time_limit_s=min(end - time.perf_counter(), 3.0)))
    notes.append(f"Found by: {best.origin}.")
    return _synthesis(best, "barrier", lower, Status.CERTIFIED if best.optimal else Status.INACCURATE, notes, start)


def _singular(plant: GeneralizedPlant, gamma: float, max_states: int, start: float, end: float) -> Synthesis:
    """Solve a plant without penalty or noise in channel 1, such as (37)-(39), by the inequalities of a regular one; no lower bound."""
    require_reachable(plant, gamma)
    notes: list[str] = []
    reasons: list[str] = []
    for scaling in _SCALINGS:
        for v in by_inequalities(regularised(plant), gamma, (scaling,), max_states, end, reasons, notes):
            best = verify(plant, v.controller, gamma, v.origin, v.optimal)
            if isinstance(best, Verified):
                notes += [
                    "Channel 1 has no control penalty or no measurement noise; small ones were added for the search, "
                    "the norms are of the plant as given.",
                    f"Found by: {best.origin}.",
                ]
                status = Status.CERTIFIED if best.optimal else Status.INACCURATE
                return _synthesis(best, "barrier", None, status, list(dict.fromkeys(notes)), start)
            reasons.append(best)
    raise _nothing_found(gamma, reasons)


def _nothing_found(gamma: float, reasons: list[str]) -> SynthesisError:
    """Say why no candidate survived."""
    why = "; ".join(dict.fromkeys(reasons)) or "nothing could be tried"
    return SynthesisError(
        f"Mixed synthesis: no controller survived; {why}. Raise gamma = {gamma:g}, max_states, noise or the time limit."
    )


def performance(plant: GeneralizedPlant) -> GeneralizedPlant:
    """Return the plant of channel 1 alone."""
    return plant.channel(plant.rows(1), plant.columns(1))


def _improved(plant: GeneralizedPlant, found: list[Verified], gamma: float, end: float) -> list[Verified]:
    """Best candidates after local improvement in balanced coordinates."""
    balanced = balance(reached(plant))
    better = []
    for v in sorted(found, key=lambda v: v.h2)[:_POLISHED]:
        left = end - time.perf_counter()
        if left <= 0:
            break
        K = balanced.inside(absorb_feedthrough(v.controller, -plant.D22))
        K = absorb_feedthrough(balanced.controller(improved(balanced.plant, K, gamma, left / 2)), plant.D22)
        verdict = verify(plant, K, gamma, f"{v.origin}; then local improvement", v.optimal)
        if isinstance(verdict, Verified):
            better.append(verdict)
    return better


def _synthesis(
    best: Verified, solver: str, lower: float | None, status: Status, notes: list[str], start: float
) -> Synthesis:
    """Report the best candidate with its bound."""
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
        solver=solver,
        notes=tuple(notes),
    )
