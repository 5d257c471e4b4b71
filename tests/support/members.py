"""Members of an uncertain set around the loop of an observer."""

import numpy as np

from kros.core.lti import StateSpace
from kros.synthesis.generalized_plant import split


def perturbed(problem, closed, delta):
    """The loop from (w1, n) to z1, scaled, with a causal perturbation from z2 to w2."""
    u = problem.nominal.n_inputs + np.arange(problem.W_L.n_inputs)
    z, y = np.split(np.arange(closed.n_outputs), [len(problem.scaled[3])])
    w = np.setdiff1d(np.arange(closed.n_inputs), u)
    ins, outs = np.concatenate([w, u]), np.concatenate([z, y])
    ordered = StateSpace(closed.A, closed.B[:, ins], closed.C[outs], closed.D[np.ix_(outs, ins)], closed.dt)
    return split(ordered, len(w), len(z)).close(delta)
