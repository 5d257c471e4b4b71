r"""Order reduction: of a controller, with its loss in the certified cost, and of a generalized plant for the cost of matrix inequalities.

A controller is balanced *in its loop*. Its states are as important as ``R R'``, their covariance while the closed loop is driven, and
``S S'``, the error that they cause through the loop, say together. These are the blocks of the closed loop's Gramians, so the weighting of the
controller's error by the plant on both sides (Enns) and the balancing of the loop's own Gramians (Wortelboer) are the same thing here, and neither
needs a stable controller. Truncation and residualisation of every order are judged by the certificate itself.

References
----------
D. F. Enns, "Model reduction with balanced realizations: an error bound and a frequency weighted generalization", 23rd CDC (1984) 127-132.
P. Wortelboer, *Frequency-weighted balanced reduction of closed-loop mechanical servo-systems*, PhD thesis, Delft (1994).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.errors import ConfigError, SynthesisError
from ...core.lti import StateSpace
from ...core.norms import h2_norm, hinf_norm
from ..generalized_plant import GeneralizedPlant
from ..problem.observer_problem import ObserverProblem
from ..problem.plants import generalized_plant
from ..result import Status, Synthesis, enclosed
from ..worst_case.certificate import certify
from .balancing import Balancing, gramian_root

_NEGLIGIBLE = 1e-10


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
        What the controller is for. The cost is the certified worst-case H2 norm; for a plant the H2 norm from its ``w1`` to its ``z1``.
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
        raise ConfigError(
            f"Order reduction: order = {order} and largest_loss_percent = {largest_loss_percent} should not be negative."
        )
    full = synthesis.controller
    before = _cost(problem, full)
    if not np.isfinite(before):
        raise SynthesisError(
            "Order reduction: the controller to be reduced does not stabilise; start from one that does."
        )
    if not full.n_states:
        return synthesis
    balancing = _balanced(problem, full)
    for k in range(full.n_states) if order is None else [min(order, full.n_states)]:
        for value, how, K in _candidates(problem, balancing, full, k):
            if order is not None or value <= before * (1 + largest_loss_percent / 100):
                note = f"order {full.n_states} reduced to {K.n_states} by {how}: cost {value:.6g} against {before:.6g} before"
                return _restated(problem, synthesis, K, note)
    if order is not None:
        raise SynthesisError(
            f"Order reduction: no controller of order {order} that was found stabilises; ask for a higher one."
        )
    return synthesis


def _cost(problem: ObserverProblem | GeneralizedPlant, K: StateSpace) -> float:
    """Certified worst-case H2 norm, or the H2 norm of channel 1; infinite where the controller does not stabilise."""
    if isinstance(problem, GeneralizedPlant):
        return h2_norm(problem.channel(problem.rows(1), problem.columns(1)).close(K))
    try:
        return certify(problem, K)[0]
    except SynthesisError:
        return float("inf")


def _balanced(problem: ObserverProblem | GeneralizedPlant, K: StateSpace) -> Balancing:
    """Balance the states of a controller by the blocks of the closed loop's Gramians."""
    if isinstance(problem, ObserverProblem):
        plant, K = generalized_plant(problem), problem.to_scaled(K)
    else:
        plant = problem.channel(problem.rows(1), problem.columns(1))
    closed, n = plant.close(K), plant.sizes[0]
    return Balancing.of(
        gramian_root(closed.A, closed.B, closed.dt)[n:], gramian_root(closed.A.T, closed.C.T, closed.dt)[n:]
    )


def _candidates(
    problem: ObserverProblem | GeneralizedPlant, balancing: Balancing, full: StateSpace, k: int
) -> list[tuple[float, str, StateSpace]]:
    """Reduced controllers of one order that stabilise, the better one first."""
    order, found = min(k, len(balancing.values)), []
    for how, reduced in (("truncation", balancing.truncated), ("residualisation", balancing.residualised)):
        try:
            K = reduced(full, order)
        except np.linalg.LinAlgError:
            continue
        if np.isfinite(value := _cost(problem, K)):
            found.append((value, how, K))
    return sorted(found, key=lambda row: row[0])


def _restated(problem: ObserverProblem | GeneralizedPlant, synthesis: Synthesis, K: StateSpace, note: str) -> Synthesis:
    """Recompute norms and certificate of another controller; a lower bound stays, since it does not depend on the controller."""
    if isinstance(problem, ObserverProblem):
        value, error = certify(problem, K)
        loop, white = problem.error_system(K), problem.nominal.n_inputs + problem.nominal.n_states
        noise = h2_norm(StateSpace(loop.A, loop.B[:, white:], loop.C, loop.D[:, white:], loop.dt))
        radius = float(loop.spectral_radius())
        found = replace(
            synthesis,
            worst_case_h2=value,
            quadrature_error=error,
            h2_norm=noise,
            hinf_norm=None,
            spectral_radius=radius,
        )
        bounded = synthesis.worst_case_h2 is not None
    else:
        value, closed, two = _cost(problem, K), problem.close(K), problem.channel(problem.rows(2), problem.columns(2))
        split = problem.n_w1 is not None or problem.n_z1 is not None
        gain = hinf_norm(two.close(K) if split else closed)
        found = replace(
            synthesis, worst_case_h2=None, h2_norm=value, hinf_norm=gain, spectral_radius=closed.largest_pole()
        )
        bounded = synthesis.method in ("h2", "mixed")
    lower, gap, notes = enclosed(value, synthesis.lower_bound) if bounded else (None, None, ())
    notes = (*synthesis.notes, note, *notes)
    return replace(found, controller=K, status=Status.CERTIFIED, lower_bound=lower, gap_percent=gap, notes=notes)


def truncate(plant: GeneralizedPlant, n_states: int) -> tuple[GeneralizedPlant, float]:
    """Balanced truncation of a stable plant from (w, u) to (z, y)."""
    B, C = np.hstack([plant.B1, plant.B2]), np.vstack([plant.C1, plant.C2])
    balancing = Balancing.of(gramian_root(plant.A, B, plant.dt), gramian_root(plant.A.T, C.T, plant.dt))
    h = balancing.values
    k = min(n_states, int(np.sum(h > _NEGLIGIBLE * h[0])))
    left, right = balancing.left[:k], balancing.right[:, :k]
    small = replace(
        plant,
        A=left @ plant.A @ right,
        B1=left @ plant.B1,
        B2=left @ plant.B2,
        C1=plant.C1 @ right,
        C2=plant.C2 @ right,
    )
    return small, float(h[k:].sum() / h[0])
