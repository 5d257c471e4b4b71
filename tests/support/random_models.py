"""Observers and models of random matrices, and what the refinement takes of simulated recordings."""

import numpy as np

from kros import from_arrays
from kros.core.lti import StateSpace
from kros.data import Channel, Role
from kros.identify import Factor, ModelSet, combine
from kros.identify.factors import lifted_factor, reduce_episode
from kros.lifting import Lifting
from kros.observer import Observer
from kros.synthesis import Injection


def random_observer(lifting, injection=Injection.STATE, order=2, *, inputs=("a", "b"), period_s=0.001, **changes):
    """An observer whose first state is measured; its parameters are 0.3."""
    rng, n, m = np.random.default_rng(0), lifting.n_lifted, len(inputs) + len(lifting.input_functions)
    A, B = 0.3 * rng.normal(size=(n, n)), rng.normal(size=(n, m))
    width = n if injection is Injection.STATE else m
    sizes = zip((0.3, 1.0, 1.0, 0.1), ((order, order), (order, 1), (width, order), (width, 1)), strict=True)
    K = StateSpace(*(size * rng.normal(size=shape) for size, shape in sizes), period_s)
    known = dict.fromkeys(lifting.parameters, 0.3)
    return Observer("koopman/test", lifting, A, B, (0,), inputs, K, injection, period_s, known, **changes)


def random_models(B, spread, formula, n_units, **changes):
    """Stable models of units that differ at random."""
    rng, parameters = np.random.default_rng(2), ("phase",) if "phase" in formula else ()
    A = np.array([[0.9, 0.1, 0.0], [0.0, 0.7, 0.1], [0.0, 0.0, 0.5]]) + spread * rng.normal(size=(n_units, 3, 3))
    states = Channel("position", Role.STATE, measured=True), Channel("velocity", Role.STATE)
    parts = {
        "name": "koopman",
        "condition": "default",
        "lifting": Lifting(("position", "velocity"), (formula,), parameters),
        "channels": (*states, Channel("target", Role.INPUT)),
        "sample_period_s": 0.01,
        "unit_ids": tuple(f"unit.{i}" for i in range(n_units)),
        "parameters": {name: np.zeros(n_units) for name in parameters},
        "input_scale": np.array([3.0]),
    }
    return ModelSet(**parts | changes, A=A, B=np.array(B) + spread * rng.normal(size=(n_units, 3, 1)))


def for_refinement(data, lifting, parameters):
    """Population of x, v and u, keys of its units, and the factor of all of them."""
    channels = Channel("x", Role.STATE), Channel("v", Role.STATE), Channel("u", Role.INPUT)
    population = from_arrays(data, channels, 0.01)
    keys = {unit: population.keys(unit) for unit in population.unit_ids}
    factors = [[reduce_episode(data[k][:, :2], data[k][:, 2:], lifting) for k in own] for own in keys.values()]
    whole = Factor.stack([combine(Factor.stack(unit)) for unit in factors])
    return population, keys, lifted_factor(whole, lifting, parameters, lifting)
