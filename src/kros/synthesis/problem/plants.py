r"""Generalized plants of the observer problem, in scaled coordinates.

For every form, with the perturbed plant in it (`observer_problem`) and the observer (18)-(21) beside it::

    w1 -> W_u -+-> s                       s, or x = G (s + [W_L w2]) + [W_L w2] -> W_R -> z2 ... Delta ... w2
               |                                   (what an inverse form sees contains W_L w2)

    at the input:  xi+ = A xi + B W_L w2 - J u,    e = xi
    at the state:  xi+ = A xi - J u,               e = xi + W_L w2        z1 = W_p e
                                                                          y  = C e + n,   u = K y

*Why this is minimal.* With ``x = G s + ...`` the state of the perturbed plant and ``x_hat+ = A x_hat + B s + J u`` the
observer, both are driven by the same ``s``, so the difference ``xi`` is not: of the two copies of the nominal model one
drops out, and the other one remains only where the perturbation sees the state, through ``x``. Likewise W_u remains for
what Delta sees alone.
The interconnection has every block once, so with minimal weights the whole is minimal but for poles that cancel between
blocks.

Symbols
-------
s : scaled input;  xi : what the observer's loop can see of the error;  e : error;  J : injection matrix
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core import StateSpace, block_diagonal, gain
from ..generalized_plant import GeneralizedPlant, Sum, interconnect, split
from .observer_problem import ObserverProblem

# In matrix inequalities: share of the measured channel's range, weight of the scaled correction.
_LEAST_NOISE, _PENALTY = 1e-3, 3e-2


def generalized_plant(problem: ObserverProblem) -> GeneralizedPlant:
    """Whole problem: w = (w1, w2, n), z = (z1, z2), without the remainder."""
    location, plant, eye = problem.form, problem.error_plant(), np.eye
    error, (n, _, n_u, n_z, q), m = plant.open_loop(), plant.sizes, problem.nominal.n_inputs
    d, r, noise, u = np.split(eye(error.n_inputs), np.cumsum([m, n, q]), axis=1)
    z, y = np.split(eye(error.n_outputs), [n_z])
    blocks = {"error": error, "W_u": problem.input_weight, "W_L": problem.W_L, "W_R": problem.W_R}
    inputs, acts = {"w1": m, "w2": problem.W_L.n_inputs, "n": q}, {"W_L": 1.0}
    wires: dict[str, Sum] = {"W_u": {"w1": 1.0}, "W_L": {"w2": 1.0}}
    if not location.sees_input:
        blocks["plant"] = problem.scaled_model
        wires["plant"] = {"W_u": 1.0} | (acts if location.inverse and location.at_input else {})
    seen = {"W_u" if location.sees_input else "plant": 1.0}
    wires["W_R"] = seen | (acts if location.inverse and location.at_input is location.sees_input else {})
    wires["error"] = {"W_L": d if location.at_input else r, "n": noise, "u": u}
    outputs: dict[str, Sum] = {"z1": {"error": z}, "z2": {"W_R": 1.0}, "y": {"error": y}}
    system = interconnect(blocks, wires, inputs | {"u": n_u}, outputs)
    return split(system, sum(inputs.values()), system.n_outputs - q)


def disturbed(problem: ObserverProblem, d: StateSpace, remainder: StateSpace | None) -> tuple[StateSpace, StateSpace]:
    """Return the disturbances at input and state: what the perturbation does, ``W_L w2``, and the remainder."""
    n, m, dt = problem.nominal.n_states, problem.nominal.n_inputs, problem.nominal.dt
    nothing = gain(np.zeros((n, 0)), dt) if remainder is None else remainder
    if problem.form.at_input:
        return d, nothing
    return gain(np.zeros((m, 0)), dt), gain(np.hstack([np.eye(n)] * 2), dt) @ block_diagonal([d, nothing])


def shaped_plant(problem: ObserverProblem, d: StateSpace, r: StateSpace) -> GeneralizedPlant:
    """White noise (nu_d, nu_r, n) through shaping filters at the input and at the state."""
    plant = problem.error_plant()
    _, _, n_u, n_z, n_y = plant.sizes
    rest = gain(np.eye(n_y + n_u), plant.dt)  # n, u
    return split(plant.open_loop() @ block_diagonal([d, r, rest]), d.n_inputs + r.n_inputs + rest.n_inputs - n_u, n_z)


def mixed_plant(problem: ObserverProblem) -> GeneralizedPlant:
    """Reduced, regularised form of (37)-(39) for every form: w = (w1, n, w2), z = (W_p e, penalty, z2).

    Matrix inequalities do not resolve an encoder's noise of 1e-7 of the range, which has a floor here, nor a problem
    without a penalty. A result is certified for the true noise.
    """
    whole = penalise(generalized_plant(problem), _PENALTY)
    noise = np.maximum(1.0, _LEAST_NOISE * (np.abs(problem.C) @ problem.output_scale) / problem.noise)
    w1, w2, n = np.split(np.arange(whole.sizes[1]), np.cumsum([len(problem.input_scale), problem.W_L.n_inputs]))
    z1, z2, penalty = np.split(np.arange(whole.sizes[3]), np.cumsum([len(problem.scaled[3]), problem.W_R.n_outputs]))
    size = np.ones(whole.sizes[1])
    size[n] = noise
    plant = whole.transformed(w=np.diag(size)).channel(np.r_[z1, penalty, z2], np.r_[w1, n, w2])
    return replace(plant, n_w1=len(w1) + len(n), n_z1=len(z1) + len(penalty))


def penalise(plant: GeneralizedPlant, penalty: float) -> GeneralizedPlant:
    """Append the weighted control to the performance outputs."""
    more = (0, plant.sizes[2]), (0, 0)
    D12 = np.vstack([plant.D12, penalty * np.eye(plant.sizes[2])])
    return replace(plant, C1=np.pad(plant.C1, more), D11=np.pad(plant.D11, more), D12=D12)
