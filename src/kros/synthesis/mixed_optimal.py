r"""Mixed H2/H-infinity synthesis (7)-(8): ``min ||T11||_2`` subject to ``||T22||_inf < gamma``, by matrix inequalities, verified.

The inequalities use one Lyapunov matrix for both channels; their value bounds ``||T11||_2`` from above, often by far. Scaling the second
channel (``w2 -> a w2``, ``z2 -> z2 / a``) leaves the problem as it is and changes that bound, so several ``a`` may be tried.

*For the paper's observer problem (37)-(39) the scaling must stay at 1.* There ``T11`` does not depend on the uncertainty and ``T22`` not on K:
the exact optimum is "no correction", and what makes the published gain useful is the common Lyapunov matrix, which adds the response to w2
to the cost. A small ``a`` only removes that term.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, SynthesisError
from ..core.lti import StateSpace
from ..core.norms import h2_norm, hinf_norm
from .balance import Balanced, balance
from .certificate import certify
from .generalized_plant import GeneralizedPlant
from .h2_optimal import absorb_feedthrough, h2, stability_margin
from .mixed_lmi import Attempt, MixedInequalities, Solution, ladder
from .observer_problem import ObserverProblem
from .reduction import truncate
from .result import Status, Synthesis

Array = npt.NDArray[Any]
_SCALINGS = (1.0, 4.0, 16.0)
_LAST_RESORT_S = 5.0  # a first-order solver that needs longer has not returned a stabilising controller in our tests
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class _Verified:
    """A controller that passed verification, with its recomputed norms and how it came about."""

    controller: StateSpace
    h2: float
    hinf: float
    margin: float
    word: str
    solver: str
    value: float
    scaling: float


def mixed(
    plant: GeneralizedPlant | ObserverProblem,
    *,
    gamma: float = 1.0,
    scalings: Sequence[float] | None = None,
    max_states: int = 8,
    time_limit_s: float = 20.0,
    noise_floor: float = 1e-3,
    penalty_floor: float = 3e-2,
) -> Synthesis:
    """Return a controller with a small H2 norm in channel 1 and an H-infinity norm below `gamma` in channel 2.

    Parameters
    ----------
    plant : GeneralizedPlant or ObserverProblem
        A regular discrete plant with its channel partition (`n_w1`, `n_z1`); or an observer problem, whose reduced and regularised plant is
        then used, and whose result is a filter in physical units with a certified ``worst_case_h2``.
    gamma : float
        Level of the H-infinity constraint.
    scalings : sequence of float
        Scalings of the second channel to try; the best verified result is kept. Default 1, 4 and 16; for observer problems 1, see above.
    max_states : int
        Stable plants are reduced to this number by balanced truncation for the inequalities only (their cost grows with the sixth power of
        the states, and states of no consequence make them ill-conditioned); where every solver fails, to two fewer. The controller is
        verified on the full plant.
    time_limit_s : float
        For each call of a solver.
    noise_floor : float
        For observer problems: least measurement noise in the inequalities, as a fraction of the measured channel's range; tenfold where the
        solver fails. Inequalities do not resolve an encoder's 1e-7. The certificate uses the true noise.
    penalty_floor : float
        For observer problems: least weight of the scaled correction in the inequalities.

    Returns
    -------
    Synthesis
        ``h2_norm`` of T11 and ``hinf_norm`` of T22 recomputed on the full plant; ``lower_bound`` is the H2 optimum without the constraint.

    Raises
    ------
    SynthesisError
        When the plant is not regular, or no solver returned a controller that survives verification (each reason is given).

    Examples
    --------
    >>> import numpy as np
    >>> from kros.synthesis import GeneralizedPlant, mixed
    >>> D11, D12 = np.zeros((3, 3)), [[0.0], [1.0], [0.0]]
    >>> plant = GeneralizedPlant([[0.9]], [[1.0, 0, 0.1]], [[1.0]], [[1.0], [0], [0.5]], [[1.0]], D11, D12, [[0, 1.0, 0]], [[0.0]], 1.0, 2, 2)
    >>> mixed(plant).hinf_norm < 1
    True
    """
    if isinstance(plant, ObserverProblem):
        options = {"gamma": gamma, "scalings": scalings or (1.0,), "max_states": max_states, "time_limit_s": time_limit_s}
        return _for_observer(plant, noise_floor, penalty_floor, options)
    scalings = _SCALINGS if scalings is None else scalings
    if plant.dt == 0:
        raise SynthesisError("Mixed synthesis works in discrete time, found a continuous plant (dt = 0); sample it.")
    if gamma <= 0 or not scalings or min(scalings) <= 0 or time_limit_s <= 0 or max_states < 1:
        raise ConfigError(
            f"Mixed synthesis: gamma = {gamma}, scalings = {tuple(scalings)}, time_limit_s = {time_limit_s}, max_states = {max_states} should all be positive."
        )
    start = time.perf_counter()
    reasons: list[str] = []
    notes: list[str] = []
    found: list[_Verified] = []
    smaller = max(max_states - 2, 1)
    tried: set[int] = set()
    for limit, last_resort in ((max_states, False), (smaller, False), (smaller, True)):
        small, notes = _reduced(plant, limit)
        if (last_resort and any("infeasible" in reason for reason in reasons)) or (not last_resort and small.sizes[0] in tried):
            continue
        tried.add(small.sizes[0])
        attempts = ladder(min(time_limit_s, _LAST_RESORT_S) if last_resort else time_limit_s, last_resort=last_resort)
        found = [v for a in scalings for v in [_best_for(plant, small, gamma, a, attempts, reasons)] if v is not None]
        if found:
            break
    if not found:
        told = "; ".join(dict.fromkeys(reason.split(". Try another solver")[0] for reason in reasons))
        raise SynthesisError(f"Mixed synthesis: no controller survived; {told}. Raise gamma, max_states, noise or the time limit.")
    best = min(found, key=lambda v: v.h2)
    return _synthesis(plant, best, notes, time.perf_counter() - start)


def _reduced(plant: GeneralizedPlant, max_states: int) -> tuple[GeneralizedPlant, list[str]]:
    """Plant for the inequalities, and what was done to it."""
    n = plant.sizes[0]
    if not plant.open_loop().is_stable():
        return plant, [f"The plant is unstable and was not reduced: {n} states in the inequalities."] if n > max_states else []
    small, tail = truncate(plant, max_states)
    kept = small.sizes[0]
    if kept == n:
        return plant, []
    return small, [
        f"Inequalities on {kept} of {n} states (discarded Hankel singular values sum to {tail:.2g} of the largest); verified on all."
    ]


def _best_for(
    plant: GeneralizedPlant, small: GeneralizedPlant, gamma: float, scaling: float, attempts: Sequence[Attempt], reasons: list[str]
) -> _Verified | None:
    """Climb the ladder of solvers for one scaling until a controller survives verification."""
    balanced = balance(_scaled(small, scaling))
    inequalities = MixedInequalities(balanced.plant, balanced.spread, gamma)
    for attempt in attempts:
        solution = inequalities.solve(attempt)
        verdict = solution if isinstance(solution, str) else _verify(plant, balanced, solution, gamma, attempt.solver, scaling)
        if isinstance(verdict, _Verified):
            return verdict
        _log.info("Mixed synthesis, scaling %g: %s", scaling, verdict)
        reasons.append(f"scaling {scaling:g}, {verdict}")
    return None


def _scaled(plant: GeneralizedPlant, a: float) -> GeneralizedPlant:
    """Scale channel 2: ``w2 -> a w2``, ``z2 -> z2 / a``."""
    left, right = np.ones(plant.sizes[3]), np.ones(plant.sizes[1])
    left[plant.rows(2)], right[plant.columns(2)] = 1 / a, a
    D11 = plant.D11 * left[:, None] * right
    return replace(plant, B1=plant.B1 * right, D21=plant.D21 * right, C1=plant.C1 * left[:, None], D12=plant.D12 * left[:, None], D11=D11)


def _verify(plant: GeneralizedPlant, balanced: Balanced, solution: Solution, gamma: float, solver: str, scaling: float) -> _Verified | str:
    """Recompute everything on the full plant; return what was found, or why it is rejected."""
    K = absorb_feedthrough(solution.controller, plant.D22)
    closed = plant.close(K)
    margin = stability_margin(closed)
    if margin >= 1:
        return f"{solver} ({solution.word}): closed loop unstable, spectral radius {margin:.6g}"
    norm, peak = h2_norm(part(plant, closed, 1)), hinf_norm(part(plant, closed, 2))
    if peak >= gamma:
        return f"{solver} ({solution.word}): ||T22|| = {peak:.6g} is not below {gamma:g}"
    value = float(np.sqrt(max(solution.value, 0.0))) * balanced.size
    return _Verified(K, norm, peak, margin, solution.word, solver, value, scaling)


def part(plant: GeneralizedPlant, closed: StateSpace, channel: int) -> StateSpace:
    """Cut T11 (channel 1) or T22 (channel 2) out of the closed loop."""
    rows, columns = plant.rows(channel), plant.columns(channel)
    return StateSpace(closed.A, closed.B[:, columns], closed.C[rows], closed.D[rows][:, columns], closed.dt)


def _synthesis(plant: GeneralizedPlant, best: _Verified, notes: list[str], elapsed: float) -> Synthesis:
    lower = h2(plant.channel(plant.rows(1), plant.columns(1))).lower_bound
    useful = lower is not None and lower > 1e-9 * best.h2
    notes.append(
        f"Value of the inequalities {best.value:.6g} (bound of the H2 norm with the common Lyapunov matrix), channel scaling {best.scaling:g}."
    )
    return Synthesis(
        method="mixed",
        controller=best.controller,
        status=Status.CERTIFIED if best.word == "optimal" else Status.INACCURATE,
        h2_norm=best.h2,
        hinf_norm=best.hinf,
        lower_bound=lower,
        gap_percent=100 * (best.h2 / lower - 1) if useful and lower else None,
        spectral_radius=best.margin,
        solve_s=elapsed,
        solver=best.solver.lower(),
        notes=tuple(notes),
    )


def _for_observer(problem: ObserverProblem, noise_floor: float, penalty_floor: float, options: dict[str, Any]) -> Synthesis:
    """Solve the reduced observer problem on noise that the inequalities resolve; certify the filter on the set, in physical units."""
    problem.require_sound()
    ranges = np.abs(problem.C) @ problem.output_scale
    reasons = []
    for floor in (noise_floor, 10 * noise_floor):
        noisy = replace(problem, noise=np.maximum(problem.noise, floor * ranges))
        try:
            found = mixed(noisy.mixed_plant(noise_floor=0.0, penalty_floor=penalty_floor), **options)
        except SynthesisError as error:
            reasons.append(f"with measurement noise of {floor:g} of the range: {error}")
        else:
            return _certified(problem, noisy, found)
    raise SynthesisError(" ".join(reasons))


def _certified(problem: ObserverProblem, noisy: ObserverProblem, found: Synthesis) -> Synthesis:
    """Certify what was found on the noisy problem for the true one."""
    controller = noisy.to_physical(found.controller)
    value, error = certify(problem, controller)
    return replace(
        found,
        controller=controller,
        injection=problem.injection,
        worst_case_h2=value,
        quadrature_error=error,
        spectral_radius=float(problem.error_system(controller).spectral_radius()),
        lower_bound=None,
        gap_percent=None,
        notes=(
            *found.notes,
            "T11 contains the measurement noise only and T22 does not depend on K; worst_case_h2 is the meaningful number. "
            "The spectral radius is that of the nominal loop and says nothing about robustness.",
        ),
    )
