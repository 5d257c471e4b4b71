r"""Does the certificate hold for the units it was made from? Errors of their models against the bounds.

For the model of every unit, without noise,

.. math:: e = S\,(G_p - G)\,W_u w_1: \qquad x_p^+ = A_p x_p + B_p s, \quad
          e^+ = A e + (A_p - A)\,x_p + (B_p - B)\,s - J u, \quad u = K C e

so that no difference of large responses is formed. The residuals that the weights cover are pseudo-inverses where a
plant has more outputs than inputs; what these leave out belongs to the additive remainder, and this check sees both:
nothing here knows of forms, weights or balls.

Symbols
-------
s : scaled input;  e : error;  x_p : state of the unit
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError
from ...core.lti import StateSpace
from ...core.norms import h2_norm
from ..problem.interconnect import interconnect
from ..problem.observer_problem import ObserverProblem
from .certificate import certify, density
from .disturbance import design_grid

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class UnitCheck:
    """Errors of the units, as far as their models tell, and the bounds that should hold for them.

    Parameters
    ----------
    units : tuple of str
    h2_norm : ndarray, shape (unit,)
        Norm of ``W_p S (Gp - G) W_u``.
    density_ratio : ndarray, shape (unit,)
        Largest ratio, over a grid of frequencies, of the unit's root power density to the bound's, both without noise:
        the sharpest test, since norms may hide a frequency.
    worst_case_h2 : float
        The certified bound, noise included.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.synthesis import UnitCheck
    >>> UnitCheck(("a",), np.array([0.1]), np.array([0.9]), worst_case_h2=0.3).holds
    True
    """

    units: tuple[str, ...]
    h2_norm: Array
    density_ratio: Array
    worst_case_h2: float

    @property
    def largest_ratio(self) -> float:
        """Largest ratio of a unit's norm to the bound; zero where there is no unit."""
        return float(np.max(self.h2_norm / self.worst_case_h2, initial=0.0))

    @property
    def holds(self) -> bool:
        """Whether every unit is below the bound."""
        return self.largest_ratio <= 1

    def rows(self) -> list[dict[str, Any]]:
        """Return the table, one row a unit."""
        columns = ("h2_norm", "density_ratio")
        return [{"unit": unit} | {c: float(getattr(self, c)[k]) for c in columns} for k, unit in enumerate(self.units)]


def check_units(
    problem: ObserverProblem, controller: StateSpace, units: StateSpace, unit_ids: Sequence[str] | None = None
) -> UnitCheck:
    """Compare the error of every unit's model with the certified bound.

    Parameters
    ----------
    problem : ObserverProblem
    controller : StateSpace
        In physical units.
    units : StateSpace
        Models in physical units, the unit axis first; only `A` (unit, n, n) and `B` (unit, n, m) are used.
    unit_ids : sequence of str, optional
        Names; default their numbers.

    Returns
    -------
    UnitCheck

    Raises
    ------
    DimensionError
        When models and nominal do not fit together.
    SynthesisError
        When there is no H2 certificate: see `certify`.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import StateSpace, gain
    >>> from kros.synthesis import ObserverProblem, check_units
    >>> lag = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01)
    >>> problem = ObserverProblem(lag, [[1.0]], gain([[0.1]], 0.01), gain([[1.0]], 0.01), [1.0], [1.0], [0.1])
    >>> A, B, C = np.full((2, 1, 1), 0.5), np.array([[[0.98]], [[1.02]]]), np.ones((2, 1, 1))
    >>> units = StateSpace(A, B, C, 0 * C, 0.01)
    >>> check_units(problem, gain([[0.2]], 0.01), units).holds
    True
    """
    n, m = problem.nominal.n_states, problem.nominal.n_inputs
    if units.A.shape[1:] != (n, n) or units.B.shape[1:] != (n, m) or units.dt != problem.nominal.dt:
        raise DimensionError(
            f"Check of units: their models should be (unit, {n}, {n}) and (unit, {n}, {m}) at {problem.nominal.dt} s, "
            f"found {units.A.shape} and {units.B.shape} at {units.dt} s."
        )
    errors = [unit_error(problem, controller, units.A[k], units.B[k]) for k in range(len(units.A))]
    freqs = design_grid(problem)
    loop = problem.error_system(controller)
    noise = loop.frequency_response(freqs)[..., m + n :]
    bound = np.sqrt(np.maximum(density(problem, loop, freqs) - np.sum(np.abs(noise) ** 2, axis=(-2, -1)), 0.0))
    size = [np.linalg.norm(e.frequency_response(freqs), axis=(-2, -1)) for e in errors]
    return UnitCheck(
        tuple(unit_ids) if unit_ids is not None else tuple(str(k) for k in range(len(errors))),
        np.array([h2_norm(e) for e in errors]),
        np.array([np.max(s / np.maximum(bound, 1e-300)) for s in size]),
        certify(problem, controller)[0],
    )


def unit_error(problem: ObserverProblem, controller: StateSpace, A_p: Array, B_p: Array) -> StateSpace:
    """Return the system from w1 to ``W_p (x - x_hat)`` for one unit, given in physical units, without noise."""
    A, B, C, _ = problem.scaled
    x, u = problem.output_scale, problem.input_scale
    n, eye, dt = len(A), np.eye(len(A)), problem.nominal.dt
    A_p, B_p = A_p * x / x[:, None], B_p * u / x[:, None]
    blocks = {
        "unit": StateSpace(A_p, eye, eye, np.zeros((n, n)), dt),
        "error": StateSpace(A, eye, eye, np.zeros((n, n)), dt),
        "K": problem.to_scaled(controller),
        "W_u": problem.input_weight,
        "W_p": problem.performance,
    }
    wires = {
        "unit": {"W_u": B_p},
        "error": {"unit": A_p - A, "W_u": B_p - B, "K": -problem.injection_matrix},
        "K": {"error": C},
        "W_u": {"w1": np.eye(problem.input_weight.n_inputs)},
        "W_p": {"error": eye},
    }
    return interconnect(
        blocks, wires, {"w1": problem.input_weight.n_inputs}, {"z1": {"W_p": np.eye(problem.performance.n_outputs)}}
    )
