r"""The linear loop of plant, estimator and controller, with the perturbation of the uncertain set in it.

        w                         z        P is the nominal with its weights (`Form` says where
        |   +-------------------+ ^        they act, and on what they see), or the model of a unit without them.
        +-->|         P         |-+        F is strictly causal and reads measurements, functions of what is
u --+------>|                   |--> x     measured, and inputs. Signals are divided by their ranges.
    |       +-------------------+    |
    +----------> F (y, x, u) <-------+--> e = x - x_hat
                     |
u = r + K x_hat <----+
"""

from __future__ import annotations

import numpy as np
from small_gain import Blocks

from kros.core.arrays import frozen
from kros.core.errors import DimensionError, SynthesisError
from kros.core.lti import StateSpace, gain
from kros.identify import ModelSet
from kros.lifting import Lifting
from kros.observer.data import ObserverData
from kros.observer.estimator.certificate import linear_part
from kros.observer.sensor import delay_of
from kros.synthesis import ObserverProblem
from kros.synthesis.generalized_plant import interconnect
from kros.uncertainty import UncertainModel


@frozen
class LinearLoop:
    """Estimator and controller in scaled signals, around any model of a set, perturbed or not."""

    models: ModelSet  # in ranges
    problem: ObserverProblem
    F: StateSpace
    K: StateSpace

    @classmethod
    def of(
        cls, observer: ObserverData, models: ModelSet, uncertain: UncertainModel, K: StateSpace
    ) -> tuple[LinearLoop, list[str]]:
        """Return the loop of a controller between estimates and recorded inputs, and what F does without."""
        x, u, dt = models.output_scale, models.input_scale, models.sample_period_s
        F, left_out = linear_estimator(observer, models.lifting)
        F = gain(np.diag(1 / x), dt) @ F @ gain(np.diag([*x[list(observer.measured)], *x, *u]), dt)
        K = gain(np.eye(len(u), K.n_outputs) / u[:, None], dt) @ K @ gain(np.eye(K.n_inputs, len(x)) * x, dt)
        problem = ObserverProblem.from_uncertain(models, uncertain, np.ones(len(models.measured)))
        return cls(models.normalised(), problem, F, K), left_out

    def unit(self, name: str) -> StateSpace:
        """Return the loop of a unit, from the command r to the error e."""
        return self._closed(self.models.systems([name])[0])

    def blocks(self) -> Blocks:
        """Return the loop of the nominal between the blocks of the perturbation, behind them that from r to e."""
        plant, sizes = perturbed_plant(self.problem)
        w, z = np.sum(sizes, axis=0)
        channel = self.problem.nominal.n_inputs, len(self.problem.scaled[3])
        return Blocks(self._closed(plant, int(w), int(z)), [*sizes, channel])

    def _closed(self, plant: StateSpace, w: int = 0, z: int = 0) -> StateSpace:
        """Close the loop around a plant from (w, u) to (z, x)."""
        C, W_p = self.problem.C, self.problem.scaled[3]
        m, n = plant.n_inputs - w, plant.n_outputs - z
        x, u = np.eye(n, z + n, z), np.eye(w + m, m, -w)
        truth, known = np.vstack([C @ x, x, np.zeros((m, z + n))]), np.eye(len(C) + n + m, m, -len(C) - n)
        wires = {"P": {"w": np.eye(w + m, w), "K": u, "r": u}, "F": {"P": truth, "K": known, "r": known}}
        outputs = {"z": {"P": np.eye(z, z + n)}, "e": {"P": W_p @ x, "F": -W_p}}
        blocks = {"P": plant, "F": self.F, "K": self.K}
        return interconnect(blocks, wires | {"K": {"F": np.eye(n)}}, {"w": w, "r": m}, outputs)


def perturbed_plant(problem: ObserverProblem) -> tuple[StateSpace, list[tuple[int, int]]]:
    """Return the scaled nominal with its weights, from (w, u) to (z, x), and the signals (w, z) of every block."""
    place, G, left, right = problem.form, problem.scaled_model, problem.W_L, problem.W_R
    u, x = np.eye(G.n_inputs), np.eye(G.n_outputs)
    effect = {"W_L": np.eye(left.n_outputs)}
    seen = {"u": u} if place.sees_input else {"G": x}
    own = effect if place.inverse and place.at_input is place.sees_input else {}
    blocks = {"G": G, "W_L": left, "W_R": right}
    wires = {"G": {"u": u} | (effect if place.at_input else {}), "W_L": {"w": np.eye(left.n_inputs)}, "W_R": seen | own}
    inputs, outputs = {"w": left.n_inputs}, {"z": {"W_R": np.eye(right.n_outputs)}}
    sizes, state = [(left.n_inputs, right.n_outputs)], {"G": x} | ({} if place.at_input else effect)
    if problem.remainder_left is not None and problem.remainder_right is not None:
        blocks |= {"R_L": problem.remainder_left, "R_R": problem.remainder_right}
        sizes.append((problem.remainder_left.n_inputs, problem.remainder_right.n_outputs))
        wires |= {"R_L": {"w of R": np.eye(sizes[1][0])}, "R_R": {"u": u}}
        inputs["w of R"], outputs["z of R"] = sizes[1][0], {"R_R": np.eye(sizes[1][1])}
        state["R_L"] = x
    return interconnect(blocks, wires, inputs | {"u": len(u)}, outputs | {"x": state}), sizes


def linear_estimator(observer: ObserverData, modelled: Lifting) -> tuple[StateSpace, list[str]]:
    """Return the estimate of a model's lifted states from (y, x, u), and the channels that are left out of it.

    Raises
    ------
    SynthesisError
        When measurements arrive late, functions read what is not measured, or it is not stable by itself.
    DimensionError
        When the observer corrects a model with other lifted states.
    """
    if observer.bank is not None:
        system, _, unknown = linear_part(observer, modelled)
        return system, unknown
    if observer.runtime.delay or delay_of(observer.sensor):
        raise SynthesisError("measurements arrive late, and the set contains no delay.")
    if observer.lifting.names != modelled.names:
        both = f"{', '.join(observer.lifting.names)}, and the models {', '.join(modelled.names)}"
        raise DimensionError(f"Loop: observer {observer.name} has the lifted states {both}; take an observer of them.")
    known = {*observer.outputs, *modelled.parameters}
    if hidden := [formula.text for formula in modelled.formulas if not formula.used <= known]:
        raise SynthesisError(f"{', '.join(hidden)} reads what is not measured.")
    n, order, nl = modelled.n_states, observer.controller.n_states, modelled.n_lifted
    theta, x_c, u, y = np.split(observer.one_step, np.cumsum([nl, order, observer.B.shape[1]]), axis=1)
    B = np.hstack([y, np.zeros((n + order, n)), theta[:, n:], u])
    C = np.eye(nl, n + order) * (np.arange(nl) < n)[:, None]
    F = StateSpace(np.hstack([theta[:, :n], x_c]), B, C, np.zeros((nl, B.shape[1])), observer.sample_period_s)
    if not F.is_stable():
        raise SynthesisError("the observer is not stable by itself.")
    return F, []
