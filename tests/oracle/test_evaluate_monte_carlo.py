"""Random members of an uncertain set: they belong to it, their errors are those of their state-space models, and none exceeds the certificate."""

from dataclasses import replace

import numpy as np
import pytest

from kros.core import StateSpace, block_diagonal, gain, h2_norm, hinf_norm
from kros.evaluate import sample_errors
from kros.evaluate.contractions import Contractions
from kros.evaluate.monte_carlo import draw_members
from kros.synthesis import Injection, ObserverProblem, worst_case_h2
from kros.synthesis.problem.plants import generalized_plant
from kros.synthesis.problem.uncertainty_location import LOCATIONS
from kros.synthesis.worst_case.causal import perturbed
from kros.synthesis.worst_case.certificate import certify
from kros.synthesis.worst_case.unit_check import unit_error
from kros.uncertainty import Form

DT = 0.01
A, B = np.array([[0.9, 0.1, 0.0], [-0.1, 0.9, 0.05], [0.0, -0.1, 0.8]]), np.array([[0.0, 0.1], [0.2, 0.0], [0.3, 0.1]])


def low_pass(pole, size):
    return StateSpace([[pole]], [[1 - pole]], [[size]], [[0.3 * size]], DT)


def problem(form, remainder=True):
    n, m = B.shape
    rows, columns = LOCATIONS[Form(form)].sizes(n, m)
    parts = {
        "nominal": StateSpace(A, B, np.eye(n), np.zeros((n, m)), DT),
        "C": np.eye(n)[:1],
        "W_L": block_diagonal([low_pass(0.8, 0.05 + 0.02 * i) for i in range(rows)]),
        "W_R": block_diagonal([low_pass(0.95, 1.0)] * columns),
        "input_scale": np.array([1.0, 2.0]),
        "output_scale": np.array([1.0, 0.5, 2.0]),
        "noise": np.array([0.02]),
        "W_u": block_diagonal([low_pass(0.7, 1.0)] * m),
        "form": form,
    }
    if remainder:
        parts |= {"remainder_left": gain(0.05 * np.eye(n), DT), "remainder_right": block_diagonal([low_pass(0.5, 1.0)] * m)}
    return ObserverProblem(**parts)


def candidates():
    return [(gain([[0.4], [0.2], [0.1]], DT), Injection.STATE), (gain([[0.1], [0.3]], DT), Injection.INPUT)]


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (2, 2), (4, 2), (1, 3)])
def test_every_member_is_a_contraction_and_its_system_is_its_response(rows, columns):
    drawn = Contractions.draw(rows, columns, 30, np.random.default_rng(1))
    theta = np.linspace(0, np.pi, 40)
    response = drawn.response(theta)
    largest = np.linalg.norm(response, 2, axis=(-2, -1))
    np.testing.assert_allclose(largest, np.broadcast_to(drawn.size[:, None], largest.shape), rtol=1e-9)  # all-pass: the same everywhere
    assert drawn.size.max() == 1
    for i in range(0, 30, 7):
        system = drawn.system(i, DT)
        assert system.is_stable()
        np.testing.assert_allclose(system.frequency_response(theta / (2 * np.pi * DT)), response[i], rtol=1e-7, atol=1e-9)
        assert hinf_norm(system) == pytest.approx(drawn.size[i], rel=1e-5)


@pytest.mark.parametrize("form", list(Form))
@pytest.mark.parametrize("remainder", [True, False])
def test_errors_of_members_are_those_of_their_state_space_models_and_below_the_certificate(form, remainder):
    case, members = problem(form, remainder), 9
    found = sample_errors(case, candidates(), members, seed=4)
    drawn, rests = draw_members(case, members, seed=4)
    for row, largest, (K, injection) in zip(found.norms, found.largest, candidates(), strict=True):
        own = replace(case, injection=injection)
        closed = generalized_plant(own).close(own.to_scaled(K))
        expected = [
            h2_norm(perturbed(own, closed, drawn.system(i, DT), rests.system(i, DT) if remainder else None)) for i in range(members)
        ]
        np.testing.assert_allclose(row, expected, rtol=2e-3)
        assert largest == pytest.approx(max(expected), rel=1e-9)
        assert largest <= certify(own, K)[0] * (1 + 1e-9)  # rounding: some bounds are attained


def test_the_worst_machine_of_a_scalar_set_is_found():
    """``Delta = 1`` is the worst contraction of ``w Delta / (1 - w Delta)``, causal, and drawn often: the largest error is the certified one."""
    w, a, dt = 0.4, 0.9, DT
    nominal = StateSpace([[a]], [[1.0]], [[1.0]], [[0.0]], dt)
    case = ObserverProblem(nominal, np.eye(1), gain([[w]], dt), gain([[1.0]], dt), np.ones(1), np.ones(1), np.array([0.1]))
    L = 0.3
    found = sample_errors(case, [(gain([[L]], dt), Injection.STATE)], 60)
    pole = a - L
    analytic = np.sqrt(((w / (1 - w)) ** 2 + (0.1 * L) ** 2) / (1 - pole**2))
    assert found.largest[0] == pytest.approx(analytic, rel=1e-9)
    assert found.norms.max() == pytest.approx(analytic, rel=1e-3)  # a trapezoidal rule
    assert certify(case, gain([[L]], dt))[0] == pytest.approx(analytic, rel=1e-4)
    assert found.noise[0] == pytest.approx(0.1 * L / np.sqrt(1 - pole**2), rel=1e-3)


def test_machines_of_the_population_have_the_error_of_their_models():
    case = problem(Form.INVERSE_INPUT_MULTIPLICATIVE)
    rng = np.random.default_rng(2)
    A_p, B_p = A + 0.02 * rng.normal(size=(3, *A.shape)), B * (1 + 0.1 * rng.normal(size=(3, *B.shape)))
    units = StateSpace(A_p, B_p, np.broadcast_to(np.eye(3), A_p.shape), np.zeros(B_p.shape), DT)
    found = sample_errors(case, candidates(), 2, units)
    for row, noise, (K, injection) in zip(found.units, found.noise, candidates(), strict=True):
        own = replace(case, injection=injection)
        expected = [np.hypot(h2_norm(unit_error(own, K, A_p[k], B_p[k])), noise) for k in range(3)]
        np.testing.assert_allclose(row, expected, rtol=2e-3)


def test_many_members_stay_below_the_certificate_of_a_robust_observer():
    case = problem(Form.INVERSE_INPUT_MULTIPLICATIVE)
    made = worst_case_h2(case, max_order=2, tolerance_db=3.0, refinements=0)
    found = sample_errors(case, [(made.controller, made.injection)], 300)
    assert found.largest[0] <= made.worst_case_h2
    assert found.largest[0] == pytest.approx(found.norms.max(), rel=2e-3)
    assert found.norms.min() >= found.noise[0]
    assert found.largest[0] > 0.5 * made.worst_case_h2  # members come close: the certificate is not empty talk
