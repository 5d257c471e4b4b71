"""Members of an uncertain set around the loop of an observer."""

import numpy as np

from kros.core.lti import StateSpace, block_diagonal
from kros.synthesis.generalized_plant import split
from kros.synthesis.problem.plants import generalized_plant


def perturbed(problem, closed, delta, rest=None):
    """The loop from (w1, n, v) to z1, scaled, with a causal perturbation from z2 to w2, and one of the remainder from z3 to w3."""
    plant = generalized_plant(problem)
    w3 = 0 if problem.remainder_left is None else problem.remainder_left.n_inputs
    u = plant.n_w1 + np.arange(problem.W_L.n_inputs + w3)
    z, y = np.split(np.arange(closed.n_outputs), [plant.n_z1])
    w = np.setdiff1d(np.arange(closed.n_inputs), u)
    ins, outs = np.concatenate([w, u]), np.concatenate([z, y])
    ordered = StateSpace(closed.A, closed.B[:, ins], closed.C[outs], closed.D[np.ix_(outs, ins)], closed.dt)
    whole = split(ordered, len(w), len(z))
    return whole.close(block_diagonal([delta, rest]) if w3 and rest is not None else delta)
