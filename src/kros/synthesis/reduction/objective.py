"""What a controller is for, and how it is judged: the certificate of an observer problem, or the H2 norm of a plant's channel 1.

Whatever changes a controller in place (order reduction, polish) asks the same questions of both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.norms import h2_norm, hinf_norm
from ..generalized_plant import GeneralizedPlant
from ..problem.observer_problem import ObserverProblem
from ..result import Status, Synthesis, enclosed
from ..riccati.h2_optimal import stability_margin
from ..worst_case.certificate import certify
from .balancing import Balancing, gramian_root
from .certified_cost import CertifiedCost


class Objective(Protocol):
    """What a controller is for."""

    def inside(self, controller: StateSpace) -> StateSpace:
        """Return the controller in the coordinates of the computation."""

    def outside(self, controller: StateSpace) -> StateSpace:
        """Inverse of `inside`."""

    def value(self, controller: StateSpace) -> float:
        """Return the cost of a controller inside; infinite where it does not stabilise."""

    def balanced(self, controller: StateSpace) -> Balancing:
        """Balance the states of a controller inside, in its loop."""

    def restated(self, synthesis: Synthesis, controller: StateSpace, what: str, seconds: float) -> Synthesis:
        """Return the synthesis with another controller (outside): all that depends on it recomputed, or left out."""


def objective_of(problem: ObserverProblem | GeneralizedPlant) -> Objective:
    """Return what a controller for this problem is for."""
    return ForObserver(problem) if isinstance(problem, ObserverProblem) else ForPlant(problem)


@dataclass(frozen=True, eq=False)
class ForObserver:
    """A correction filter, judged by the certified worst-case H2 norm."""

    problem: ObserverProblem

    def inside(self, controller: StateSpace) -> StateSpace:
        """Return the filter in scaled coordinates."""
        return self.problem.to_scaled(controller)

    def outside(self, controller: StateSpace) -> StateSpace:
        """Return the filter in physical units."""
        return self.problem.to_physical(controller)

    def value(self, controller: StateSpace) -> float:
        """Return the certified worst-case H2 norm."""
        try:
            return certify(self.problem, self.outside(controller))[0]
        except SynthesisError:
            return float("inf")

    def balanced(self, controller: StateSpace) -> Balancing:
        """Balance by the spectra of the uncertain set."""
        cost = CertifiedCost.around(self.problem, controller)
        return Balancing.of(*cost.roots(cost.loop.theta(controller)))

    def restated(self, synthesis: Synthesis, controller: StateSpace, what: str, seconds: float) -> Synthesis:
        """Recompute the certificate; the lower bound stays, since it does not depend on the filter."""
        problem = self.problem
        value, error = certify(problem, controller)
        before = certify(problem, synthesis.controller)[0]
        loop, white = problem.error_system(controller), problem.nominal.n_inputs + problem.nominal.n_states
        lower, gap, notes = enclosed(value, synthesis.lower_bound) if synthesis.bounded_in_h2 else (None, None, ())
        change = 100 * (value / before - 1)
        stale: dict[str, Any] = dict.fromkeys(("hinf_norm", "worst_case_hinf", "causal_h2"))
        return replace(
            synthesis,
            controller=controller,
            status=Status.CERTIFIED,
            h2_norm=h2_norm(StateSpace(loop.A, loop.B[:, white:], loop.C, loop.D[:, white:], loop.dt)),
            **stale,
            worst_case_h2=value,
            lower_bound=lower,
            gap_percent=gap,
            quadrature_error=error,
            spectral_radius=float(loop.spectral_radius()),
            solve_s=synthesis.solve_s + seconds,
            notes=(*synthesis.notes, f"{what}: certified worst-case H2 {value:.6g} against {before:.6g} before ({change:+.2f} %)", *notes),
        )


@dataclass(frozen=True, eq=False)
class ForPlant:
    """A controller of a general plant, judged by the H2 norm from its w1 to its z1."""

    plant: GeneralizedPlant

    def inside(self, controller: StateSpace) -> StateSpace:
        """Return the controller as it is."""
        return controller

    def outside(self, controller: StateSpace) -> StateSpace:
        """Return the controller as it is."""
        return controller

    def value(self, controller: StateSpace) -> float:
        """Return the H2 norm of channel 1."""
        return h2_norm(self.plant.channel(self.plant.rows(1), self.plant.columns(1)).close(controller))

    def balanced(self, controller: StateSpace) -> Balancing:
        """Balance by the blocks of the closed loop's Gramians."""
        plant, n = self.plant, self.plant.sizes[0]
        closed = plant.channel(plant.rows(1), plant.columns(1)).close(controller)
        return Balancing.of(gramian_root(closed.A, closed.B, closed.dt)[n:], gramian_root(closed.A.T, closed.C.T, closed.dt)[n:])

    def restated(self, synthesis: Synthesis, controller: StateSpace, what: str, seconds: float) -> Synthesis:
        """Recompute both norms, channel by channel where the plant has two."""
        plant = self.plant
        one, two = plant.channel(plant.rows(1), plant.columns(1)), plant.channel(plant.rows(2), plant.columns(2))
        split = plant.n_w1 is not None or plant.n_z1 is not None
        closed = plant.close(controller)
        value, before = h2_norm(one.close(controller)), h2_norm(one.close(synthesis.controller))
        lower, gap, notes = enclosed(value, synthesis.lower_bound) if synthesis.method in ("h2", "mixed") else (None, None, ())
        stale: dict[str, Any] = dict.fromkeys(("worst_case_h2", "worst_case_hinf", "causal_h2"))
        return replace(
            synthesis,
            controller=controller,
            status=Status.CERTIFIED,
            **stale,
            h2_norm=value,
            hinf_norm=hinf_norm(two.close(controller) if split else closed),
            lower_bound=lower,
            gap_percent=gap,
            spectral_radius=stability_margin(closed),
            solve_s=synthesis.solve_s + seconds,
            notes=(
                *synthesis.notes,
                f"{what}: H2 norm {value:.6g} against {before:.6g} before ({100 * (value / before - 1):+.2f} %)",
                *notes,
            ),
        )
