r"""Order reduction of a controller, with its loss in the certified cost, and of a generalized plant.

A controller is balanced *in its loop*, by the blocks of the closed loop's Gramians that belong to its states. So the
weighting of its error by the plant on both sides (Enns) and the balancing of the loop's Gramians (Wortelboer) are the
same here, and neither needs a stable controller. Every order is judged by the certificate itself.

References
----------
D. F. Enns, "Model reduction with balanced realizations: an error bound and a frequency weighted generalization", 23rd
CDC (1984) 127-132. P. Wortelboer, *Frequency-weighted balanced reduction of closed-loop mechanical servo-systems*, PhD
thesis, Delft (1994).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, SynthesisError
from ..core.linalg import balancing
from ..core.lti import StateSpace
from ..core.norms import gramian_root, h2_norm, hinf_norm
from .generalized_plant import GeneralizedPlant
from .problem.observer_problem import ObserverProblem
from .problem.plants import generalized_plant
from .result import Status, Synthesis, enclosed
from .worst_case.certificate import certified

Array = npt.NDArray[Any]

_NEGLIGIBLE = 1e-10  # Hankel singular values below this share of the largest are rounding


def reduce_controller(
    problem: ObserverProblem | GeneralizedPlant,
    synthesis: Synthesis,
    order: int | None = None,
    largest_loss_percent: float = 2.0,
) -> Synthesis:
    """Return the controller of lowest order whose certified cost is close to that of the full one.

    Parameters
    ----------
    problem : ObserverProblem or GeneralizedPlant
        What the controller is for. The cost is the certified worst-case H2 norm; for a plant the H2 norm from its
        ``w1`` to its ``z1``.
    synthesis : Synthesis
        Its controller stabilises.
    order : int, optional
        Reduce to this order, whatever it costs. Default: the lowest with at most `largest_loss_percent`.
    largest_loss_percent : float

    Returns
    -------
    Synthesis
        Norms, stability and certificate recomputed; a note says from which order to which, how, and at what loss.

    Raises
    ------
    ConfigError
        When an option is out of range.
    SynthesisError
        When no controller of the order asked for stabilises.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import StateSpace
    >>> from kros.synthesis import GeneralizedPlant, h2, reduce_controller
    >>> A, D11, D12 = np.diag([0.9, 1e-4]), np.zeros((2, 2)), [[0.0], [1.0]]
    >>> B1, C1 = [[1.0, 0.0], [1e-3, 0.0]], [[1.0, 0.0], [0.0, 0.0]]
    >>> plant = GeneralizedPlant(A, B1, [[1.0], [0.0]], C1, [[1.0, 1e-3]], D11, D12, [[0.0, 1.0]], [[0.0]], 1.0)
    >>> optimum = h2(plant)
    >>> optimum.controller.n_states, reduce_controller(plant, optimum).controller.n_states
    (2, 0)
    """
    if largest_loss_percent < 0 or (order is not None and order < 0):
        options = f"order = {order} and largest_loss_percent = {largest_loss_percent}"
        raise ConfigError(f"Order reduction: {options} should not be negative.")
    full = synthesis.controller
    before = _verified(problem, full, synthesis)
    if before is None:
        raise SynthesisError("Order reduction: the controller does not stabilise; start from one that does.")
    left, right = _balanced(problem, full)
    limit = _cost(before) * (1 + largest_loss_percent / 100) if order is None else np.inf
    for k in range(full.n_states) if order is None else [min(order, full.n_states)]:
        K = StateSpace(left[:k] @ full.A @ right[:, :k], left[:k] @ full.B, full.C @ right[:, :k], full.D, full.dt)
        reduced = _verified(problem, K, synthesis)
        if full.n_states and reduced is not None and _cost(reduced) <= limit:
            return _bounded(reduced, synthesis, before)
    if order is not None and full.n_states:
        raise SynthesisError(f"Order reduction: no controller of order {order} stabilises; ask for a higher one.")
    return synthesis


def _verified(problem: ObserverProblem | GeneralizedPlant, K: StateSpace, synthesis: Synthesis) -> Synthesis | None:
    """Recompute norms and certificate of a controller; None where it does not stabilise."""
    if isinstance(problem, ObserverProblem):
        try:
            return certified(problem, K, synthesis.method)
        except SynthesisError:
            return None
    closed, value = problem.close(K), h2_norm(problem.performance.close(K))
    if not np.isfinite(value):
        return None
    whole = problem.n_w1 is None and problem.n_z1 is None
    peak = hinf_norm(closed if whole else problem.uncertainty.close(K))
    norms: dict[str, Any] = {"h2_norm": value, "hinf_norm": peak, "spectral_radius": closed.largest_pole()}
    return Synthesis(synthesis.method, K, Status.CERTIFIED, **norms, solver="riccati")


def _cost(synthesis: Synthesis) -> float:
    """Certified worst-case H2 norm, or the H2 norm of channel 1."""
    return float(synthesis.worst_case_h2 or synthesis.h2_norm or 0.0)


def _balanced(problem: ObserverProblem | GeneralizedPlant, K: StateSpace) -> tuple[Array, Array]:
    """Balance the states of a controller by the blocks of the closed loop's Gramians."""
    if isinstance(problem, ObserverProblem):
        plant, K = generalized_plant(problem), problem.to_scaled(K)
    else:
        plant = problem.performance
    closed, n = plant.close(K), plant.sizes[0]
    roots = gramian_root(closed.A, closed.B, closed.dt)[n:], gramian_root(closed.A.T, closed.C.T, closed.dt)[n:]
    return balancing(*roots, _NEGLIGIBLE)[:2]


def _bounded(reduced: Synthesis, full: Synthesis, before: Synthesis) -> Synthesis:
    """State what the reduction cost.

    A lower bound of the same cost stays, since it does not depend on the controller.
    """
    same = full.worst_case_h2 is not None if reduced.worst_case_h2 is not None else full.method in ("h2", "mixed")
    lower, gap, notes = enclosed(_cost(reduced), full.lower_bound) if same else (None, None, ())
    orders = f"order {full.controller.n_states} reduced to {reduced.controller.n_states}"
    note = f"{orders} by balanced truncation: cost {_cost(reduced):.6g} against {_cost(before):.6g} before"
    return replace(reduced, solve_s=full.solve_s, lower_bound=lower, gap_percent=gap, notes=(*full.notes, note, *notes))


def truncate(plant: GeneralizedPlant, n_states: int) -> tuple[GeneralizedPlant, float]:
    """Balanced truncation of a stable plant, and the sum of the discarded Hankel singular values over the largest."""
    B, C = np.hstack([plant.B1, plant.B2]), np.vstack([plant.C1, plant.C2])
    roots = gramian_root(plant.A, B, plant.dt), gramian_root(plant.A.T, C.T, plant.dt)
    left, right, values = balancing(*roots, _NEGLIGIBLE)
    k = min(n_states, len(values))
    return plant.transformed(x=(left[:k], right[:, :k])), float(values[k:].sum() / values[0])
