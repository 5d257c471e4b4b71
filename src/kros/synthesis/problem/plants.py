r"""Generalized plants of the observer problem, in scaled coordinates.

For every form, with the perturbed plant in it (`observer_problem`) and the observer (18)-(21) beside it::

    w1 -> W_u -+-> s                       s, or x = G (s + [W_L w2]) + [W_L w2] -> W_R -> z2 ... Delta ... w2
               |                                   (what an inverse form sees contains W_L w2)
               +-> W_rR -> z3 ... Delta_r ... w3

    at the input:  xi+ = A xi + B W_L w2 + v - J u,    e = xi + W_rL w3
    at the state:  xi+ = A xi + v - J u,               e = xi + W_L w2 + W_rL w3        z1 = W_p e
                                                                                        y  = C e + n,   u = K y

*Why this is minimal.* With ``x = G s + ...`` the state of the perturbed plant and ``x_hat+ = A x_hat + B s + J u`` the
observer, both are driven
by the same ``s``, so the difference ``xi`` is not: of the two copies of the nominal model one drops out, and the other
one remains only where the perturbation sees the state, through ``x``. Likewise W_u remains for what Delta sees alone.
The interconnection has every block once, so with minimal weights the whole is minimal but for poles that cancel between
blocks.

Symbols
-------
s : scaled input;  xi : what the observer's loop can see of the error;  e : error;  J : injection matrix
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.arrays import AnyArray
from ...core.lti import StateSpace, block_diagonal, gain
from ..generalized_plant import GeneralizedPlant, split
from .interconnect import interconnect
from .observer_problem import ObserverProblem

# In matrix inequalities: share of the measured channel's range, weight of the scaled correction.
_LEAST_NOISE, _PENALTY = 1e-3, 3e-2


def generalized_plant(problem: ObserverProblem) -> GeneralizedPlant:
    """Whole problem: w = (w1, w2, [w3], n, [v]), z = (z1, z2, [z3]); brackets for remainder and process noise."""
    A, B, C, W_p = problem.scaled
    location, J, eye = problem.location, problem.injection_matrix, np.eye
    n, m, q = len(A), B.shape[1], len(C)
    whole = StateSpace(A, eye(n), eye(n), np.zeros((n, n)), problem.nominal.dt)
    blocks = {"error": whole, "W_u": problem.input_weight}
    blocks |= {"W_L": problem.W_L, "W_R": problem.W_R}
    inputs = {"w1": m, "w2": problem.W_L.n_inputs}
    error = {"error": eye(n)} | ({} if location.at_input else {"W_L": eye(n)})
    drive = {"u": -J} | ({"W_L": B} if location.at_input else {})
    own = {"W_L": eye(problem.W_L.n_outputs)} if location.inverse else {}
    seen = {"W_u": eye(m)} if location.sees_input else {"plant": eye(n)}
    wires: dict[str, dict[str, AnyArray]] = {"W_u": {"w1": eye(m)}, "W_L": {"w2": eye(inputs["w2"])}}
    if not location.sees_input:
        blocks["plant"] = whole
        wires["plant"] = {"W_u": B} | ({"W_L": B} if location.inverse and location.at_input else {})
    wires["W_R"] = seen | (own if location.at_input is location.sees_input else {})
    outputs = {"z2": {"W_R": eye(problem.W_R.n_outputs)}}
    if problem.remainder_left is not None and problem.remainder_right is not None:
        blocks |= {"W_rL": problem.remainder_left, "W_rR": problem.remainder_right}
        inputs["w3"] = problem.remainder_left.n_inputs
        wires |= {"W_rL": {"w3": eye(inputs["w3"])}, "W_rR": {"W_u": eye(m)}}
        outputs["z3"] = {"W_rR": eye(problem.remainder_right.n_outputs)}
        error["W_rL"] = eye(n)
    inputs["n"] = q
    if problem.scaled_process_noise.any():
        inputs["v"] = n
        drive["v"] = np.diag(problem.scaled_process_noise)
    wires["error"] = drive
    performance, measured = ({name: rows @ matrix for name, matrix in error.items()} for rows in (W_p, C))
    outputs = {"z1": performance} | outputs
    whole_outputs = outputs | {"y": measured | {"n": eye(q)}}
    system = interconnect(blocks, wires, inputs | {"u": J.shape[1]}, whole_outputs)
    sizes = [next(iter(row.values())).shape[0] for row in outputs.values()]
    return split(system, sum(inputs.values()), sum(sizes), n_w1=m, n_z1=sizes[0])


def disturbed(problem: ObserverProblem, d: StateSpace, remainder: StateSpace | None) -> tuple[StateSpace, StateSpace]:
    """Return the disturbances at input and state: what the perturbation does, ``W_L w2``, and the remainder."""
    n, m, dt = problem.nominal.n_states, problem.nominal.n_inputs, problem.nominal.dt
    nothing = gain(np.zeros((n, 0)), dt) if remainder is None else remainder
    if problem.location.at_input:
        return d, nothing
    return gain(np.zeros((m, 0)), dt), gain(np.hstack([np.eye(n)] * 2), dt) @ block_diagonal([d, nothing])


def shaped_plant(problem: ObserverProblem, d: StateSpace, r: StateSpace) -> GeneralizedPlant:
    """White noise (nu_d, nu_r, n, v) through shaping filters at the input and at the state."""
    plant = problem.error_plant()
    _, _, n_u, n_z, n_y = plant.sizes
    rest = gain(np.eye(n_y + problem.nominal.n_states + n_u), plant.dt)  # n, v, u
    return split(plant.open_loop() @ block_diagonal([d, r, rest]), d.n_inputs + r.n_inputs + rest.n_inputs - n_u, n_z)


def mixed_plant(problem: ObserverProblem) -> GeneralizedPlant:
    """Reduced, regularised form of (37)-(39) for every form: w = (w1, n, w2), z = (W_p e, penalty, z2).

    Matrix inequalities do not resolve an encoder's noise of 1e-7 of the range, which has a floor here, nor a problem
    without a penalty. A result is certified for the true noise.
    """
    whole = generalized_plant(replace(problem, remainder_left=None, remainder_right=None, process_noise=None))
    whole = penalise(whole, _PENALTY)
    noise = np.maximum(1.0, _LEAST_NOISE * (np.abs(problem.C) @ problem.output_scale) / problem.noise)
    w1, w2, n = np.split(np.arange(whole.sizes[1]), np.cumsum([len(problem.input_scale), problem.W_L.n_inputs]))
    z1, z2, penalty = np.split(np.arange(whole.sizes[3]), np.cumsum([len(problem.scaled[3]), problem.W_R.n_outputs]))
    size = np.ones(whole.sizes[1])
    size[n] = noise
    plant = whole.transformed(w=np.diag(size)).channel(np.r_[z1, penalty, z2], np.r_[w1, n, w2])
    return replace(plant, n_w1=len(w1) + len(n), n_z1=len(z1) + len(penalty))


def penalise(plant: GeneralizedPlant, penalty: float) -> GeneralizedPlant:
    """Append the weighted control to the performance outputs."""
    n, n_w, n_u, _, _ = plant.sizes
    return replace(
        plant,
        C1=np.vstack([plant.C1, np.zeros((n_u, n))]),
        D11=np.vstack([plant.D11, np.zeros((n_u, n_w))]),
        D12=np.vstack([plant.D12, penalty * np.eye(n_u)]),
    )
