r"""The paper's mixed H2/H-infinity observer (7)-(8), (37)-(39): ``min ||T11||_2`` subject to ``||T22||_inf < 1``.

In the paper's problem T11 does not depend on the uncertainty and T22 not on K: the exact optimum is "no correction".
What makes the published gain useful is the Lyapunov matrix that both channels of the matrix inequalities share, which
adds the response to w2 to the cost. The published problem has ``W_R = W_u = 1``: channel 2 is scaled until the response
from the inputs to z2, which K does not influence, has a gain of one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core import ITERATED, Names, StateSpace, SynthesisError, require_kind
from ...core.norms import gramian_root, h2_norm, hinf_norm
from ..generalized_plant import GeneralizedPlant
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import mixed_plant
from ..result import Status, Synthesis
from ..riccati.h2 import balancing
from ..worst_case.worst_case_h2 import certified
from .barrier import Ending, minimise
from .inequalities import MixedInequalities

_ACCURACY = 1e-4  # of the inequalities' optimum, relative
_STATES = 8  # of the plant in the inequalities, at most: their cost grows with the sixth power of the states
_REMEDY = "raise noise, penalty or the number of steps"


def mixed(problem: ObserverProblem, *, steps: int = 400) -> Synthesis:
    """Return the paper's observer filter, from a reduced and regularised plant, certified on the set itself.

    Parameters
    ----------
    problem : ObserverProblem
    steps : int
        Newton steps for the inequalities, at most; the filter of the last one is returned.

    Returns
    -------
    Synthesis
        A filter in physical units. ``h2_norm`` of T11 and ``hinf_norm`` of T22 are recomputed on the regularised plant,
        ``worst_case_h2`` is certified for the set.

    Raises
    ------
    ConfigError
        When it is no observer problem.
    SynthesisError
        When the problem is not sound (`ObserverProblem.require_sound`), or the filter does not survive verification
        (with the reason).

    Examples
    --------
    >>> from kros.core import StateSpace, gain
    >>> from kros.synthesis import ObserverProblem, mixed
    >>> lag, W_L, W_R = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01), gain([[0.1]], 0.01), gain([[1.0]], 0.01)
    >>> observer = mixed(ObserverProblem(lag, [[1.0]], W_L, W_R, [1.0], [1.0], [0.1]))
    >>> observer.hinf_norm < 1, observer.worst_case_h2 > 0
    (True, True)
    """
    require_kind(problem, ObserverProblem, "Mixed synthesis", "build one, or use h2 or hinf for a generalized plant")
    problem.require_sound()
    idle = certified(problem, problem.nothing, "mixed")
    if idle.worst_case_h2 == 0:
        note = "No model of the set differs from the nominal one: without correction there is no error."
        return replace(idle, status=Status.OPTIMAL, lower_bound=0.0, notes=(note,))
    plant = mixed_plant(problem)
    peak = hinf_norm(plant.channel(plant.rows(2), plant.columns(1)).close(problem.nothing)) or 1.0
    best = by_inequalities(scaled(plant, peak), steps)
    result = certified(problem, problem.to_physical(best.controller), "mixed")
    notes = [
        "T11 contains the measurement noise only and T22 does not depend on K; worst_case_h2 is the meaningful number. "
        "The spectral radius is that of the nominal loop and says nothing about robustness."
    ]
    if (result.worst_case_h2 or 0.0) >= (idle.worst_case_h2 or 0.0):
        notes.append(f"No better than no correction, whose certified worst case is {idle.worst_case_h2:.6g}.")
    norms = {name: getattr(best, name) for name in ("status", "h2_norm", "hinf_norm")}
    return replace(result, **norms, notes=(*best.notes, *notes))


def scaled(plant: GeneralizedPlant, a: float) -> GeneralizedPlant:
    """Scale channel 2: ``w2 -> a w2``, ``z2 -> z2 / a``."""
    z, w = np.ones(plant.sizes[3]), np.ones(plant.sizes[1])
    z[plant.rows(2)], w[plant.columns(2)] = 1 / a, a
    return plant.transformed(z=np.diag(z), w=np.diag(w))


def by_inequalities(plant: GeneralizedPlant, steps: int = 400) -> Synthesis:
    """Return the controller of a plant (D22 = 0) from the inequalities of its reduced model, verified on all of it."""
    small, reduced = _reduced(plant)
    inequalities = MixedInequalities.of(small)
    parts = inequalities.objective(), inequalities.blocks(), inequalities.start()
    solved = minimise(*parts, rtol=_ACCURACY, steps=steps)
    if solved.x is None or not np.isfinite(solved.value):
        raise SynthesisError(f"Mixed synthesis: the inequalities have no solution, {solved.ending.value}; {_REMEDY}.")
    bound = inequalities.norm * np.sqrt(max(solved.value, 0.0))
    note = f"The inequalities bound the H2 norm by {bound:.6g} ({solved.ending.value})."
    status = Status.CERTIFIED if solved.ending is Ending.SOLVED else Status.INACCURATE
    return replace(verify(plant, inequalities.controller(solved.x)), status=status, notes=(*reduced, note))


def verify(plant: GeneralizedPlant, controller: StateSpace) -> Synthesis:
    """Recompute everything on the plant; a `SynthesisError` says why the controller is rejected."""
    closed = plant.close(controller)
    radius = closed.largest_pole() if closed.is_finite() else np.inf
    if not radius < 1:
        raise SynthesisError(f"Mixed synthesis: the loop is unstable, spectral radius {radius:.6g}; {_REMEDY}.")
    norm, peak = h2_norm(plant.performance.close(controller)), hinf_norm(plant.uncertainty.close(controller))
    if peak >= 1 or not np.isfinite(norm):
        norms = f"||T22|| = {peak:.6g} should be below 1, ||T11||_2 = {norm:.6g} finite"
        raise SynthesisError(f"Mixed synthesis: {norms}; {_REMEDY}.")
    return Synthesis("mixed", controller, Status.CERTIFIED, h2_norm=norm, hinf_norm=peak, spectral_radius=radius)


def _reduced(plant: GeneralizedPlant) -> tuple[GeneralizedPlant, Names]:
    """Plant for the inequalities of a stable one, and what was done to it; measurements in units of their noise."""
    noise = np.linalg.norm(plant.D21[:, plant.columns(1)], axis=1)
    small, tail = truncate(plant.transformed(y=np.diag(1 / noise)), _STATES)
    if small.sizes[0] == plant.sizes[0]:
        return plant, ()
    states = f"Inequalities on {small.sizes[0]} of {plant.sizes[0]} states"
    note = f"{states} (discarded Hankel singular values sum to {tail:.2g} of the largest); verified on all."
    return small.transformed(y=np.diag(noise)), (note,)


def truncate(plant: GeneralizedPlant, n_states: int) -> tuple[GeneralizedPlant, float]:
    """Balanced truncation of a stable plant, and the sum of the discarded Hankel singular values over the largest."""
    B, C = np.hstack([plant.B1, plant.B2]), np.vstack([plant.C1, plant.C2])
    roots = gramian_root(plant.A, B), gramian_root(plant.A.T, C.T)
    left, right, values = balancing(*roots, ITERATED)
    k = min(n_states, len(values))
    return plant.transformed(x=(left[:k], right[:, :k])), float(values[k:].sum() / values[0])
