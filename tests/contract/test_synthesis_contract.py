"""One contract for all observer syntheses: what the result claims is recomputed here from the result and the problem
alone."""

import numpy as np
import pytest

from kros.core import StateSpace, block_diagonal, gain
from kros.synthesis import Injection, ObserverProblem, Status, Synthesis, mixed, worst_case_h2
from kros.synthesis.worst_case.certificate import certify_errors

DT = 1e-2


def problem(injection):
    nominal = StateSpace(
        [[1.0, 0.01, 0.0], [-0.05, 0.9, 0.1], [0.0, -0.1, 0.7]],
        [[0.0, 0.0], [0.05, 0.0], [0.1, 0.3]],
        np.eye(3),
        np.zeros((3, 2)),
        DT,
    )
    lag = StateSpace([[0.8]], [[1.0]], [[-0.03]], [[0.3]], DT)
    return ObserverProblem(
        nominal=nominal,
        C=[[1.0, 0.0, 0.0]],
        W_L=block_diagonal([lag, lag]),
        W_R=gain(np.diag([1.0, 0.7]), DT),
        input_scale=[2.0, 1.0],
        output_scale=[1.0, 3.0, 1.0],
        noise=[1e-3],
        injection=injection,
    )


METHODS = {
    "worst_case_h2": lambda case: worst_case_h2(case, max_order=0),
    "worst_case_h2 fitted": worst_case_h2,
    "mixed": mixed,
}


CASES = [(name, Injection.STATE) for name in METHODS] + [("mixed", Injection.INPUT)]


@pytest.mark.parametrize(("method", "injection"), CASES)
def test_claims_are_recomputed(method, injection):
    case = problem(injection)
    found = METHODS[method](case)
    assert isinstance(found, Synthesis)
    assert found.injection is injection
    assert isinstance(found.status, Status)
    assert (found.controller.n_outputs, found.controller.n_inputs) == (
        (2, 1) if injection is Injection.INPUT else (3, 1)
    )
    K, J = found.controller, case.nominal.B if injection is Injection.INPUT else np.eye(3)
    error_dynamics = np.block([[case.nominal.A - J @ K.D @ case.C, -J @ K.C], [K.B @ case.C, K.A]])
    loop = np.abs(np.linalg.eigvals(error_dynamics)).max()
    assert loop < 1
    assert found.spectral_radius == pytest.approx(loop, rel=1e-6)
    value = certify_errors(case, case.error_system(found.controller))
    assert found.worst_case_h2 == pytest.approx(value, rel=1e-6)
    if found.lower_bound is not None:
        assert 0 < found.lower_bound <= found.worst_case_h2
        assert found.gap_percent == pytest.approx(100 * (found.worst_case_h2 / found.lower_bound - 1))


@pytest.mark.parametrize("method", METHODS)
def test_one_lower_bound_serves_every_method(method):
    bound = worst_case_h2(problem(Injection.STATE)).lower_bound
    for injection in Injection.INPUT, Injection.STATE:
        assert METHODS[method](problem(injection)).worst_case_h2 >= bound
