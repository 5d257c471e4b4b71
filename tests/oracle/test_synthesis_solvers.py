"""The barrier method against closed forms; plants at the edge of what can be computed."""

from dataclasses import replace

import numpy as np
import pytest

from kros.core import SynthesisError, hinf_norm
from kros.synthesis import GeneralizedPlant, h2, hinf
from kros.synthesis.mixed_norms.barrier import Block, Ending, minimise
from kros.synthesis.mixed_norms.mixed import by_inequalities


def largest_eigenvalue(matrix):
    """``min t`` subject to ``t I - M >= 0``."""
    d = len(matrix)
    return np.ones(1), [Block(-matrix[None], np.eye(d)[None, None])], np.zeros(1)


def random_symmetric(seed, d=6):
    M = np.random.default_rng(seed).standard_normal((d, d))
    return (M + M.T) / 2


def test_lower_bound_and_value_enclose_the_optimum():
    for seed in range(5):
        M, truth = random_symmetric(seed), np.linalg.eigvalsh(random_symmetric(seed))[-1]
        for rtol in (1e-1, 1e-3, 1e-6):
            found = minimise(*largest_eigenvalue(M), rtol=rtol)
            assert found.lower <= truth <= found.value
            assert found.value - found.lower <= rtol * abs(found.value) * (1 + 1e-9)


def test_infeasible_is_told_from_stalled_and_from_the_limit_of_steps():
    contradiction = Block(np.array([[[-1.0]], [[0.5]]]), np.array([[[[1.0]], [[-1.0]]]]))  # x >= 1 and x <= 0.5
    assert minimise(np.ones(1), [contradiction], np.zeros(1)).ending is Ending.INFEASIBLE
    c, blocks, start = largest_eigenvalue(random_symmetric(0))
    assert minimise(c, blocks, start, steps=0).ending is Ending.STEPS
    assert minimise(c, [Block(b.constant, 0 * b.basis) for b in blocks], start).x is None


def plant(**changes):
    parts = {
        "A": np.diag([0.9, 0.5]),
        "B1": [[1.0, 0, 0.3], [1.0, 0, 0]],
        "B2": [[1.0], [0.5]],
        "C1": [[1.0, 1.0], [0, 0], [0.3, 0]],
        "C2": [[1.0, 0.5]],
        "D11": np.zeros((3, 3)),
        "D12": [[0], [0.5], [0]],
        "D21": [[0, 0.5, 0]],
        "D22": [[0.0]],
        "dt": 1.0,
        "n_w1": 2,
        "n_z1": 2,
    }
    return GeneralizedPlant(**{**parts, **changes})


def test_inequalities_within_one_step_end_with_a_reason():
    with pytest.raises(SynthesisError, match="limit of steps"):
        by_inequalities(plant(), 1)


def test_ill_conditioned_units_are_solved_alike():
    T, inverse = np.diag([1e7, 1e-7]), np.diag([1e-7, 1e7])
    p = plant()
    other = replace(p, A=T @ p.A @ inverse, B1=T @ p.B1, B2=T @ p.B2, C1=p.C1 @ inverse, C2=p.C2 @ inverse)
    assert by_inequalities(other).h2_norm == pytest.approx(by_inequalities(p).h2_norm, rel=1e-2)


def test_states_that_nothing_reaches_or_sees_do_no_harm():
    p = plant()
    B1, B2 = np.vstack([p.B1, np.zeros((1, 3))]), np.vstack([p.B2, [[0.0]]])
    C1, C2 = np.hstack([p.C1, [[1.0], [0], [0]]]), np.hstack([p.C2, [[0.0]]])
    wide = replace(p, A=np.diag([0.9, 0.5, 0.3]), B1=B1, B2=B2, C1=C1, C2=C2)
    assert by_inequalities(wide).h2_norm == pytest.approx(by_inequalities(p).h2_norm, rel=1e-2)


PATHOLOGICAL = {
    "chain of delays": np.diag(np.ones(19), 1),
    "chain of integrators": np.eye(6) + np.diag(np.ones(5), 1),
    "poles within rounding of the circle": np.diag([1 - 1e-14, 1 + 1e-14, 0.5]),
    "poles at both ends of the circle": np.diag([-1.0, 1.0, 0.3]),
    "sixteen decades": np.diag([1e8, 1e-8, 0.5]),
    "many unstable poles": 0.3 * np.random.default_rng(1).standard_normal((40, 40)),
    "huge": np.diag([1e12, 2e12]),
}


def pathological(name):
    """Plants at the edge of what can be computed."""
    A, rng = PATHOLOGICAL[name], np.random.default_rng(2)
    n = len(A)
    B1, B2, C1, C2 = (rng.standard_normal(shape) for shape in ((n, 2), (n, 1), (2, n), (1, n)))
    B1, C1, D12 = np.hstack([B1, np.zeros((n, 1))]), np.vstack([C1, np.zeros((1, n))]), [[0], [0], [1.0]]
    return GeneralizedPlant(A, B1, B2, C1, C2, np.zeros((3, 3)), D12, [[0, 0, 1.0]], [[0.0]], 1.0)


@pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore::scipy.linalg.LinAlgWarning")
@pytest.mark.parametrize("method", [h2, hinf])
@pytest.mark.parametrize("name", PATHOLOGICAL)
def test_nothing_hangs_and_nothing_is_returned_unverified(method, name):
    p = pathological(name)
    try:
        found = method(p)
    except SynthesisError:
        return
    closed = p.close(found.controller)
    assert closed.is_stable()
    assert found.hinf_norm == pytest.approx(hinf_norm(closed), rel=1e-4)
