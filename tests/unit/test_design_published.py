"""The paper's own observer: its weights bound entries, and its plant is the published one."""

from types import SimpleNamespace

import numpy as np
import pytest
from paper_plant import reduced_plant

from kros.core.lti import StateSpace, gain
from kros.design.methods.robust import Published, as_published
from kros.design.task import Design
from kros.synthesis import Injection, ObserverProblem
from kros.synthesis.problem.plants import mixed_plant
from kros.uncertainty import residual

DT, UNITS, METHOD = 0.01, ("a", "b", "c"), Published(max_order=2)


def population() -> StateSpace:
    """Three machines of two states and two inputs that differ in poles and couplings."""
    spread = np.array([-0.02, 0.0, 0.03])[:, None, None]
    A = np.array([[0.9, 0.05], [0.0, 0.8]]) + spread * np.array([[1.0, 0.5], [0.4, -1.0]])
    B = np.array([[0.1, 0.02], [0.03, 0.2]]) * (1 + 3 * spread)
    return StateSpace(A, B, np.broadcast_to(np.eye(2), (3, 2, 2)), np.zeros((3, 2, 2)), DT)


@pytest.fixture(scope="module")
def task():
    systems = population()
    nominal = StateSpace(systems.A[1], systems.B[1], np.eye(2), np.zeros((2, 2)), DT)
    wide = gain(0.3 * np.eye(2), DT)
    problem = ObserverProblem(
        nominal, np.eye(2)[[0]], wide, gain(np.eye(2), DT), np.ones(2), np.ones(2), np.array([1e-3])
    )
    models = SimpleNamespace(
        frequencies=lambda: np.geomspace(0.01, 50, 200),
        scaled_responses=lambda freqs, ids: systems.frequency_response(freqs),
        sample_period_s=DT,
    )
    return SimpleNamespace(
        name="koopman_edmd/paper",
        models=models,
        require_problem=lambda: problem,
        problem=problem,
        covered=UNITS,
        unit="b",
        designed=lambda synthesis, **facts: Design("paper", None, synthesis, facts),
    )


def test_every_entry_of_every_residual_is_below_its_weight(task):
    weight = METHOD.weights(task).system
    freqs = np.geomspace(0.01, 49, 200)
    responses = population().frequency_response(freqs)
    entries = np.abs(residual("inverse_input_multiplicative", responses[1], responses)).max(axis=0)
    assert np.all(entries <= np.abs(weight.frequency_response(freqs)) * (1 + 1e-6))


def test_the_plant_is_the_published_one_with_noise_and_penalty(task):
    weight = METHOD.weights(task).system
    problem = as_published(task.problem, weight)
    assert problem.injection is Injection.INPUT
    published = reduced_plant(problem.nominal, problem.C / 1e-3, gain(np.eye(2), DT), gain(np.eye(2), DT), weight)
    freqs = np.geomspace(0.01, 49, 20)
    ours, theirs = (plant.open_loop().frequency_response(freqs) for plant in (mixed_plant(problem), published))
    rows, columns = np.r_[0:2, 4:6, 6], np.r_[0:2, 3:5, 5:7]  # without penalty outputs and noise inputs
    assert ours[:, rows][:, :, columns] == pytest.approx(theirs, abs=1e-8 * np.abs(theirs).max())


def test_what_is_made_says_that_its_weights_cover_nothing(task):
    found = METHOD.design(task)
    made, facts = found.synthesis, found.facts
    assert made.method == "paper"
    assert made.worst_case_h2 is None  # nothing is certified for the set of these weights
    assert facts["unstructured_excess"] > 1
    assert any("bound entries" in note for note in made.notes)
    loop = as_published(task.problem, gain(0.1 * np.eye(2), DT)).error_system(made.controller)
    assert float(loop.spectral_radius()) < 1
