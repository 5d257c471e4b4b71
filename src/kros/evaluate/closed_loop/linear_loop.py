r"""The linear loop of plant, estimator and controller, with the perturbation of the uncertain set in it.

    w                           z       G is the nominal model, or that of a unit without a perturbation.
    +--> W_L --+     +--> W_R --+       `Form` says where W_L w acts, and what W_R sees.
               v     |                  F is strictly causal and reads measurements, functions of what is
u --+--------> G ----+----> x           measured, and inputs. Signals are divided by their ranges.
    |                       |
    +-----> F (y, x, u) <---+--> e = x - x_hat
                 |
u = r + K x_hat <+
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...core import DimensionError, Record, StateSpace, SynthesisError, frozen, gain
from ...identify import ModelSet
from ...lifting import Lifting
from ...observer import delay_of
from ...observer.data import ObserverData
from ...observer.estimator.certificate import linear_part
from ...synthesis import ObserverProblem
from ...synthesis.generalized_plant import interconnect
from ...uncertainty import Form, UncertainModel
from .small_gain import Blocks


@frozen
class LinearLoop:
    """Estimator and controller in scaled signals, around any plant, perturbed or not."""

    problem: ObserverProblem
    F: StateSpace
    K: StateSpace

    @classmethod
    def of(
        cls, observer: ObserverData, models: ModelSet, uncertain: UncertainModel, K: StateSpace
    ) -> tuple[LinearLoop, list[str]]:
        """Return the loop of a controller between estimates and recorded inputs, and what F does without."""
        x, u = models.output_scale, models.input_scale
        problem = ObserverProblem.from_uncertain(models, uncertain, np.ones(len(models.measured)))
        F, left_out = linear_estimator(observer, models.lifting)
        K = gain(np.eye(len(u), K.n_outputs) / u[:, None], K.dt) @ K @ gain(np.eye(K.n_inputs, len(x)) * x, K.dt)
        return cls(problem, problem.scaled_estimate(F), K), left_out

    def perturbed(self) -> Blocks:
        """Return the loop of the nominal between the blocks of the perturbation, behind them that from r to e."""
        problem = self.problem
        both = [(problem.W_L, problem.W_R, problem.form)]
        if problem.remainder_left is not None and problem.remainder_right is not None:
            both.append((problem.remainder_left, problem.remainder_right, Form.ADDITIVE))
        return self.around(problem.scaled_model, both)

    def around(self, G: StateSpace, perturbations: Sequence[tuple[StateSpace, StateSpace, Form]] = ()) -> Blocks:
        """Close the loop around a plant with weights of perturbations, left and right."""
        _, _, C, W_p = self.problem.scaled
        n, m, blocks, u, x = G.n_outputs, G.n_inputs, {"G": G, "F": self.F, "K": self.K}, {"K": 1.0, "r": 1.0}, ["G"]
        wires: Record = {"G": dict(u), "K": {"F": 1.0}}
        inputs, outputs, sizes = dict[str, int](), Record(), []
        for i, (left, right, form) in enumerate(perturbations):
            L, R = f"L{i}", f"R{i}"
            blocks |= {L: left, R: right}
            own = {L: 1.0} if form.inverse and form.at_input is form.sees_input else {}
            wires |= {L: {f"w{i}": 1.0}, R: (u if form.sees_input else {"G": 1.0}) | own}
            if form.at_input:
                wires["G"][L] = 1.0
            else:
                x.append(L)
            sizes.append((left.n_inputs, right.n_outputs))
            inputs[f"w{i}"], outputs[f"z{i}"] = left.n_inputs, {R: 1.0}
        truth, known = np.vstack([C, np.eye(n), np.zeros((m, n))]), np.eye(len(C) + n + m, m, -len(C) - n)
        wires["F"] = dict.fromkeys(x, truth) | dict.fromkeys(u, known)
        outputs["e"] = dict.fromkeys(x, W_p) | {"F": -W_p}
        return Blocks(interconnect(blocks, wires, inputs | {"r": m}, outputs), [*sizes, (m, len(W_p))])


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
