r"""Mixed H2/H-infinity synthesis (7)-(8): ``min ||T11||_2`` subject to ``||T22||_inf < gamma``.

Where the H2 optimum of channel 1 meets the constraint, it is the optimum. Elsewhere matrix inequalities with one
Lyapunov matrix for both channels give controllers. They bound ``||T11||_2`` from above, often by far. The scaling of
channel 2, ``w2 -> a w2`` and ``z2 -> z2 / a``, leaves the problem as it is and changes that bound, so that several are
tried: an impulse of w1 must not leave more energy in z2 than gamma squared, so a is a few times ``||T21||_2 / gamma``.
The H2 optimum without the constraint is a lower bound.

*Observers* (37)-(39). In the paper's problem T11 does not depend on the uncertainty and T22 not on K: the exact optimum
is "no correction". What makes the published gain useful is the common Lyapunov matrix, which adds the response to w2 to
the cost. So scalings are not searched here, which would only remove the correction. The published
problem has ``W_R = W_u = 1``: channel 2 is scaled until the response from the inputs to z2, which K does not influence,
has a gain of one.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.linalg import LinAlgError

from ...core.errors import ConfigError, KrosError, SynthesisError
from ...core.linalg import balancing
from ...core.lti import StateSpace, gain
from ...core.norms import gramian_root, h2_norm, hinf_norm
from ..assumptions import h2_violations, require, require_plant
from ..generalized_plant import GeneralizedPlant
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import mixed_plant
from ..result import Status, Synthesis, enclosed
from ..riccati.equations import absorb_feedthrough
from ..riccati.h2 import h2
from ..riccati.hinf import hinf
from ..riccati.hinf_level import scale
from ..riccati.parrott import frequency_bound
from ..worst_case.certificate import certified
from .barrier import Ending, minimise
from .inequalities import MixedInequalities, balance

_ACCURACY = 1e-4  # of the inequalities' optimum, relative
_NEGLIGIBLE = 1e-10  # Hankel singular values below this share of the largest are rounding
_SCALINGS = (2.0, 4.0, 8.0)  # of channel 2, times the least that the inequalities allow around the H2 optimum


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
        Stable plants are reduced to this number by balanced truncation for the inequalities, whose cost grows with the
        sixth power of the states. The controller is verified on the full plant.
    time_limit_s : float, s
        For the whole search; the best controller at that time is returned.

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
        When the plant is not regular, when gamma is proven to be out of reach (with the least that is not), or when the
        controller does not survive verification (with the reason).

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
        options = f"gamma = {gamma}, time_limit_s = {time_limit_s}, max_states = {max_states}"
        raise ConfigError(f"Mixed synthesis: {options} should all be positive.")
    start = time.perf_counter()
    of_observer = isinstance(plant, ObserverProblem)
    design = partial(_for_observer, plant) if of_observer else partial(_for_plant, plant)  # type: ignore[arg-type]
    return replace(design(gamma, max_states, time_limit_s), solve_s=time.perf_counter() - start)


def _for_plant(plant: GeneralizedPlant, gamma: float, max_states: int, time_limit_s: float) -> Synthesis:
    """Return the H2 optimum where it meets the constraint, else the best controller of the inequalities."""
    end = time.perf_counter() + time_limit_s
    require_plant(plant, "Mixed synthesis")
    if plant.dt == 0 or not plant.sizes[0]:
        raise SynthesisError("Mixed synthesis needs a discrete plant with states; sample a continuous one.")
    require(plant.performance, "Mixed synthesis")
    free = h2(plant.performance)
    peak = hinf_norm(plant.uncertainty.close(free.controller))
    if peak < gamma:
        note = "The H2 optimum meets the constraint: it is the optimum of the mixed problem."
        return replace(free, method="mixed", hinf_norm=peak, notes=(note,))
    two = plant.uncertainty
    least = _least(two) if two.D11.size else 0.0
    if least >= gamma:
        raise _infeasible(gamma, least)
    bare = replace(plant, D22=np.zeros_like(plant.D22))
    cross = h2_norm(plant.channel(plant.rows(2), plant.columns(1)).close(free.controller)) / gamma or 1.0
    plants = [scaled(bare, scaling * cross) for scaling in _SCALINGS]
    candidates = _candidates(plants, gamma, max_states, end)
    norms = [candidate.h2_norm or 0.0 for candidate in candidates]
    result = candidates[int(np.argmin(norms))]
    lower, gap, notes = enclosed(min(norms), free.lower_bound)
    controller = absorb_feedthrough(result.controller, plant.D22)
    return replace(result, controller=controller, lower_bound=lower, gap_percent=gap, notes=(*result.notes, *notes))


def _least(plant: GeneralizedPlant) -> float:
    """Return an H-infinity norm that no controller is below; of a singular plant what single frequencies prove."""
    if h2_violations(plant, proper=False):
        return frequency_bound(scale(plant))
    return hinf(plant).lower_bound or 0.0


def _candidates(plants: list[GeneralizedPlant], gamma: float, max_states: int, end: float) -> list[Synthesis]:
    """Controllers from the inequalities, one for each scaling that works."""
    results, reasons = [], []
    for plant in plants:
        try:
            results.append(by_inequalities(plant, gamma, max_states, end - time.perf_counter()))
        except (KrosError, LinAlgError) as error:
            reasons.append(str(error))
    if not results:
        raise SynthesisError(" ".join(dict.fromkeys(reasons)))
    return results


def _for_observer(problem: ObserverProblem, gamma: float, max_states: int, time_limit_s: float) -> Synthesis:
    """Solve the reduced observer problem, and certify the filter on the set in physical units."""
    size = problem.require_sound()
    nothing = gain(np.zeros((problem.correction_size, len(problem.C))), problem.nominal.dt)
    idle = certified(problem, nothing, "mixed")
    if idle.worst_case_h2 == 0:
        note = "No model of the set differs from the nominal one: without correction there is no error."
        return replace(idle, status=Status.OPTIMAL, lower_bound=0.0, notes=(note,))
    if size >= gamma:  # K does not enter T22 = N
        raise _infeasible(gamma, size)
    plant = mixed_plant(problem)
    peak = hinf_norm(plant.channel(plant.rows(2), plant.columns(1)).close(nothing)) or 1.0
    best = by_inequalities(scaled(plant, peak), gamma, max_states, time_limit_s)
    result = certified(problem, problem.to_physical(best.controller), "mixed")
    notes = [
        "T11 contains the measurement noise only and T22 does not depend on K; worst_case_h2 is the meaningful number. "
        "The spectral radius is that of the nominal loop and says nothing about robustness."
    ]
    if (result.worst_case_h2 or 0.0) >= (idle.worst_case_h2 or 0.0):
        notes.append(f"No better than no correction, whose certified worst case is {idle.worst_case_h2:.6g}.")
    norms = {name: getattr(best, name) for name in ("status", "h2_norm", "hinf_norm", "solver")}
    return replace(result, **norms, notes=(*best.notes, *notes))


def scaled(plant: GeneralizedPlant, a: float) -> GeneralizedPlant:
    """Scale channel 2: ``w2 -> a w2``, ``z2 -> z2 / a``."""
    z, w = np.ones(plant.sizes[3]), np.ones(plant.sizes[1])
    z[plant.rows(2)], w[plant.columns(2)] = 1 / a, a
    return plant.transformed(z=np.diag(z), w=np.diag(w))


def by_inequalities(plant: GeneralizedPlant, gamma: float, max_states: int, time_limit_s: float) -> Synthesis:
    """Return the controller of a plant (D22 = 0) from the inequalities of its reduced model, verified on all of it."""
    small, reduced = _reduced(plant, max_states)
    inequalities = MixedInequalities(balance(small), gamma)
    parts = inequalities.objective(), inequalities.blocks(), inequalities.start()
    solved = minimise(*parts, rtol=_ACCURACY, time_limit_s=time_limit_s)
    remedy = f"raise gamma = {gamma:g}, max_states, noise or the time limit"
    if solved.x is None or not np.isfinite(solved.value):
        raise SynthesisError(f"Mixed synthesis: the inequalities have no solution, {solved.ending.value}; {remedy}.")
    bound = inequalities.balanced.size * np.sqrt(max(solved.value, 0.0))
    note = f"The inequalities bound the H2 norm by {bound:.6g} ({solved.ending.value})."
    status = Status.CERTIFIED if solved.ending is Ending.SOLVED else Status.INACCURATE
    result = verify(plant, inequalities.controller(solved.x), gamma, remedy)
    return replace(result, status=status, notes=(*reduced, note))


def verify(plant: GeneralizedPlant, controller: StateSpace, gamma: float, remedy: str) -> Synthesis:
    """Recompute everything on the plant; a `SynthesisError` says why the controller is rejected."""
    closed = plant.close(controller)
    finite = all(np.isfinite(getattr(closed, name)).all() for name in "ABCD")
    radius = closed.largest_pole() if finite else np.inf
    if not radius < 1:
        raise SynthesisError(f"Mixed synthesis: the loop is unstable, spectral radius {radius:.6g}; {remedy}.")
    norm, peak = h2_norm(plant.performance.close(controller)), hinf_norm(plant.uncertainty.close(controller))
    if peak >= gamma or not np.isfinite(norm):
        norms = f"||T22|| = {peak:.6g} should be below gamma, ||T11||_2 = {norm:.6g} finite"
        raise SynthesisError(f"Mixed synthesis: {norms}; {remedy}.")
    return Synthesis(
        method="mixed",
        controller=controller,
        status=Status.CERTIFIED,
        h2_norm=norm,
        hinf_norm=peak,
        spectral_radius=radius,
        solver="barrier",
    )


def _reduced(plant: GeneralizedPlant, max_states: int) -> tuple[GeneralizedPlant, tuple[str, ...]]:
    """Plant for the inequalities, and what was done to it; measurements count in units of their noise."""
    noise = np.linalg.norm(plant.D21[:, plant.columns(1)], axis=1)
    if plant.open_loop().largest_pole() >= 1:
        return plant, ()
    small, tail = truncate(plant.transformed(y=np.diag(1 / noise)), max_states)
    if small.sizes[0] == plant.sizes[0]:
        return plant, ()
    states = f"Inequalities on {small.sizes[0]} of {plant.sizes[0]} states"
    note = f"{states} (discarded Hankel singular values sum to {tail:.2g} of the largest); verified on all."
    return small.transformed(y=np.diag(noise)), (note,)


def truncate(plant: GeneralizedPlant, n_states: int) -> tuple[GeneralizedPlant, float]:
    """Balanced truncation of a stable plant, and the sum of the discarded Hankel singular values over the largest."""
    B, C = np.hstack([plant.B1, plant.B2]), np.vstack([plant.C1, plant.C2])
    roots = gramian_root(plant.A, B), gramian_root(plant.A.T, C.T)
    left, right, values = balancing(*roots, _NEGLIGIBLE)
    k = min(n_states, len(values))
    return plant.transformed(x=(left[:k], right[:, :k])), float(values[k:].sum() / values[0])


def _infeasible(gamma: float, least: float) -> SynthesisError:
    """Error for a level that no controller attains."""
    return SynthesisError(
        f"Mixed synthesis: gamma = {gamma:g} is infeasible, no controller has ||T22|| below {least:.6g}; raise gamma, "
        "or make the weights of channel 2 smaller."
    )
