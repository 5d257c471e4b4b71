"""Polish of a controller at its own order: descent on the cost itself, with analytic gradients.

    controller --> typical sizes of its entries --> BFGS on the cost --> certificate --> accepted if it is lower --> again

For an observer problem the cost is the certified worst-case H2 norm; for a plant the H2 norm of channel 1, with channel 2 kept below a bound.
The problem is not convex: the result is a local optimum, never worse than the start.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, SynthesisError
from ...core.lti import StateSpace
from ...core.norms import hinf_norm
from ..generalized_plant import GeneralizedPlant
from ..problem.observer_problem import ObserverProblem
from ..result import Synthesis
from ..worst_case.certificate import certify
from .affine_loop import AffineLoop
from .bounded_cost import BoundedCost
from .certified_cost import CertifiedCost
from .descent import bfgs
from .objective import ForObserver, objective_of

Array = npt.NDArray[Any]
Cost = Callable[[Array], tuple[float, Array]]

_WORTH = 1e-4  # a round that lowers the norm by less than this fraction is the last
_HALVINGS = 5
_BARRIERS = (1e-2, 1e-3, 1e-4, 1e-5)


def polish(
    problem: ObserverProblem | GeneralizedPlant,
    synthesis: Synthesis,
    *,
    bound: float | None = None,
    rounds: int = 4,
    iterations: int = 150,
) -> Synthesis:
    r"""Return a controller of the same order with a lower cost, or the one given.

    Parameters
    ----------
    problem : ObserverProblem or GeneralizedPlant
        What the controller is for. For an observer problem the certified worst-case H2 norm is lowered; for a plant
        :math:`\|T_{11}\|_2`, the norm from its ``w1`` to its ``z1``.
    synthesis : Synthesis
        Start: a stabilising controller, for a plant with `bound` one that keeps it.
    bound : float, optional
        For plants: :math:`\|T_{22}\|_\infty` stays below this.
    rounds : int
        Descents, each with the certificate (or a lower barrier) renewed.
    iterations : int
        Steps of each.

    Returns
    -------
    Synthesis
        The same method and kind; norms and certificate recomputed; a note says what was gained.

    Raises
    ------
    ConfigError
        When `bound` is given for an observer problem, an option is not positive, or the plant is continuous.
    SynthesisError
        When the start is unstable or above the bound.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.synthesis import GeneralizedPlant, h2, polish
    >>> plant = GeneralizedPlant([[0.9]], [[1.0, 0.0]], [[1.0]], [[1.0], [0.0]], [[1.0]], [[0, 0], [0, 0]], [[0], [1.0]], [[0, 1.0]], [[0]], 1.0)
    >>> optimum = h2(plant)
    >>> bool(abs(polish(plant, optimum).h2_norm / optimum.h2_norm - 1) < 1e-9)
    True
    """
    if rounds < 1 or iterations < 1 or (bound is not None and not bound > 0):
        raise ConfigError(f"Polish: rounds = {rounds}, iterations = {iterations} and bound = {bound} should be positive.")
    if isinstance(problem, GeneralizedPlant) and problem.dt == 0:
        raise ConfigError("Polish works in discrete time, found a continuous plant (dt = 0); sample it.")
    start = time.perf_counter()
    if isinstance(problem, ObserverProblem):
        if bound is not None:
            raise ConfigError("Polish: bound is for general plants; an observer problem has its certificate. Leave bound out.")
        K = _polished_observer(problem, synthesis.controller, rounds, iterations)
    else:
        K = _polished_plant(problem, synthesis.controller, bound, rounds, iterations)
    return objective_of(problem).restated(synthesis, K, "polished", time.perf_counter() - start)


def descend(cost: Cost, size: Array, theta: Array, iterations: int) -> Array:
    """Lower a cost from Theta, its entries counted in their typical size."""
    first = cost(theta)[0]

    def scaled(x: Array) -> tuple[float, Array]:
        value, gradient = cost(theta + size * x.reshape(theta.shape))
        return value / first, (gradient * size).ravel() / first

    return np.asarray(theta + size * bfgs(scaled, np.zeros(theta.size), iterations).reshape(theta.shape))


def _polished_observer(problem: ObserverProblem, controller: StateSpace, rounds: int, iterations: int) -> StateSpace:
    objective = ForObserver(problem)
    K, (value, _) = objective.inside(controller), certify(problem, controller)
    for _ in range(rounds):
        cost = CertifiedCost.around(problem, K)
        theta = cost.loop.theta(K)
        step = descend(cost, cost.typical(theta), theta, iterations) - theta
        found, trial = float("inf"), K
        for halving in range(_HALVINGS):
            trial = cost.loop.controller(theta + 0.5**halving * step)
            found = objective.value(trial)
            if found < value:
                break
        if not found < value:
            break
        gain, K, value = 1 - found / value, trial, found
        if gain < _WORTH:
            break
    return objective.outside(K)


def _polished_plant(plant: GeneralizedPlant, controller: StateSpace, bound: float | None, rounds: int, iterations: int) -> StateSpace:
    loop = AffineLoop(plant, controller.n_states)
    theta = loop.theta(controller)
    rows, columns = plant.rows(1), plant.columns(1)
    value, _ = loop.h2_squared(theta, rows, columns)
    if not np.isfinite(value):
        raise SynthesisError("Polish: the start does not stabilise the plant; start from a controller that does.")
    if bound is not None and not (found := hinf_norm(plant.channel(plant.rows(2), plant.columns(2)).close(controller))) < bound:
        raise SynthesisError(f"Polish: ||T22|| = {found:.6g} of the start should be below the bound {bound:.6g}; raise the bound.")
    for barrier in _BARRIERS[:rounds] if bound is not None else (0.0,):
        cost: Cost
        if bound is None:

            def cost(t: Array) -> tuple[float, Array]:
                return loop.h2_squared(t, rows, columns)
        else:
            cost = BoundedCost.around(loop, theta, bound, barrier * value)
        trial = descend(cost, loop.typical(theta), theta, iterations)
        found = loop.h2_squared(trial, rows, columns)[0]
        if found < value:
            theta, value = trial, found
    return loop.controller(theta)
