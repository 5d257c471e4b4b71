"""Order reduction: balancing against closed forms, the loop's Gramians against Lyapunov equations, the loss against
the certificate."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_lyapunov

from kros.core import ConfigError, StateSpace, SynthesisError, block_diagonal, gain, hinf_norm
from kros.core.norms import gramian_root
from kros.synthesis import GeneralizedPlant, Injection, ObserverProblem, Status, h2, reduce_controller, worst_case_h2
from kros.synthesis.reduction import _balanced, truncate
from kros.synthesis.worst_case.certificate import certify

DT = 1e-3


def lag(low, high, corner_hz):
    a = np.exp(-2 * np.pi * corner_hz * DT)
    d, c = np.linalg.solve([[1, 1 / (1 - a)], [1, -1 / (1 + a)]], [low, high])
    return StateSpace([[a]], [[1.0]], [[c]], [[d]], DT)


def drive_problem(injection, remainder=False):
    """A motor drive with a slow and a fast mode, uncertain at both inputs."""
    kt, b, kp, kv, wc = 60, 3, 12, 3, 600
    A = np.array([[0, 1, 0, 0], [0, -b, kt, 2], [-wc * kv * kp, -wc * kv, -wc, 0], [0.5, 1, 0, -30]])
    B = np.array([[0, 0], [0, 0], [wc * kv * kp, wc * kv], [0, 0]])
    M = expm(DT * np.block([[A, B], [np.zeros((2, 6))]]))
    rest = {}
    if remainder:
        rest = {
            "remainder_left": block_diagonal([lag(0.004, 0.0004, 5.0 * (i + 1)) for i in range(4)]),
            "remainder_right": gain(np.eye(2), DT),
        }
    return ObserverProblem(
        nominal=StateSpace(M[:4, :4], M[:4, 4:], np.eye(4), np.zeros((4, 2)), DT),
        C=np.eye(4)[:1],
        W_L=block_diagonal([lag(0.01, 0.3, 10.0) @ lag(1.0, 1.5, 40.0), lag(0.02, 0.4, 30.0) @ lag(1.0, 1.3, 3.0)]),
        W_R=gain(np.diag([1.0, 0.6]), DT),
        input_scale=[3.0, 3.0],
        output_scale=[3.0, 3.0, 0.5, 1.0],
        noise=[1e-4],
        n_original=3,
        injection=injection,
        **rest,
    )


def random_plant(rng, n=5):
    A = rng.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    shapes = ((n, 3), (n, 2), (3, n), (2, n), (3, 3), (3, 2), (2, 3))
    return GeneralizedPlant(A, *(rng.standard_normal(s) for s in shapes), 0.1 * rng.standard_normal((2, 2)), 1.0)


@pytest.mark.parametrize("distance", [1e-2, 1e-6, 1e-10])
def test_root_of_the_gramian_keeps_its_digits_near_the_circle(distance):
    a, b = 1 - distance, np.array([[1.0, 0.5]])
    R = gramian_root(np.array([[a]]), b, 1.0)
    exact = 1.25 / ((1 - a) * (1 + a))
    assert float(R[0] @ R[0]) == pytest.approx(exact, rel=1e-12 + 2e-16 / distance), (
        "as many digits as rounding a to a double leaves"
    )


def test_truncation_error_is_within_twice_the_tail():
    rng = np.random.default_rng(0)
    for _ in range(5):
        plant = random_plant(rng, 6)
        system = plant.open_loop()
        P, Q = (
            solve_discrete_lyapunov(system.A, system.B @ system.B.T),
            solve_discrete_lyapunov(system.A.T, system.C.T @ system.C),
        )
        hankel = np.sqrt(np.sort(np.linalg.eigvals(P @ Q).real)[::-1])
        for k in range(1, 6):
            small, tail = truncate(plant, k)
            assert tail * hankel[0] == pytest.approx(hankel[k:].sum(), rel=1e-7)
            reduced = small.open_loop()
            A = block_diagonal([system, reduced]).A
            B, C = np.vstack([system.B, reduced.B]), np.hstack([system.C, -reduced.C])
            error = StateSpace(A, B, C, system.D - reduced.D, 1.0)
            assert hinf_norm(error) <= 2 * hankel[k:].sum() * (1 + 1e-6)


def test_balancing_in_the_loop_is_enns_weighting():
    plant = random_plant(np.random.default_rng(1))
    K = h2(plant).controller
    closed, n = plant.close(K), plant.sizes[0]
    P, Q = (
        solve_discrete_lyapunov(closed.A, closed.B @ closed.B.T),
        solve_discrete_lyapunov(closed.A.T, closed.C.T @ closed.C),
    )
    values = np.sqrt(np.sort(np.linalg.eigvals(P[n:, n:] @ Q[n:, n:]).real)[::-1])
    left, right = _balanced(plant, K)
    assert np.diag(left @ P[n:, n:] @ left.T) == pytest.approx(values[: len(left)], rel=1e-7)
    assert np.diag(right.T @ Q[n:, n:] @ right) == pytest.approx(values[: len(left)], rel=1e-7)
    # Enns: the controller's covariance with its input weighted by (I - P22 K)^-1 P21, by quadrature on the circle
    freqs = np.linspace(-0.5, 0.5, 4001)[1:]
    open_loop = plant.open_loop().frequency_response(freqs)
    P21, P22, response = open_loop[:, 3:, :3], open_loop[:, 3:, 3:], K.frequency_response(freqs)
    weight = np.linalg.solve(np.eye(2) - P22 @ response, P21)
    states = StateSpace(K.A, K.B, np.eye(K.n_states), np.zeros_like(K.B), 1.0).frequency_response(freqs) @ weight
    weighted = np.mean(states @ np.conj(np.swapaxes(states, -1, -2)), axis=0).real
    assert weighted == pytest.approx(P[n:, n:], rel=1e-6, abs=1e-8 * np.abs(P).max())


def test_states_of_no_consequence_go_without_loss():
    plant = random_plant(np.random.default_rng(2))
    optimum = h2(plant)
    K = optimum.controller
    rng = np.random.default_rng(3)
    junk = StateSpace(np.diag([0.5, -0.3, 0.999]), rng.standard_normal((3, 2)), np.zeros((2, 3)), np.zeros((2, 2)), 1.0)
    T = rng.standard_normal((8, 8))
    A, B, C = block_diagonal([K, junk]).A, np.vstack([K.B, junk.B]), np.hstack([K.C, junk.C])
    padded = StateSpace(T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), K.D, 1.0)
    found = reduce_controller(plant, replace(optimum, controller=padded), largest_loss_percent=1e-6)
    assert found.controller.n_states <= 5
    assert found.h2_norm == pytest.approx(optimum.h2_norm, rel=1e-8)
    assert f"order 8 reduced to {found.controller.n_states}" in found.notes[-1]


@pytest.fixture(scope="module")
def designs():
    problems = [drive_problem(Injection.STATE, remainder=True), drive_problem(Injection.INPUT)]
    return [(p, worst_case_h2(p, max_order=2, tolerance_db=0.1)) for p in problems]


def test_the_lowest_order_within_the_loss_and_its_certificate(designs):
    for problem, full in designs:
        found = reduce_controller(problem, full)
        assert found.controller.n_states <= 6 < full.controller.n_states
        assert found.worst_case_h2 <= 1.02 * full.worst_case_h2
        assert found.worst_case_h2 == pytest.approx(certify(problem, found.controller)[0])
        assert found.gap_percent == pytest.approx(100 * (found.worst_case_h2 / full.lower_bound - 1))
        assert found.status is Status.CERTIFIED
        assert found.spectral_radius < 1


def test_an_order_that_is_asked_for(designs):
    problem, full = designs[1]
    assert reduce_controller(problem, full, order=2).controller.n_states == 2


def test_what_cannot_be_reduced_is_refused(designs):
    problem, full = designs[1]
    with pytest.raises(ConfigError, match="order = -1"):
        reduce_controller(problem, full, order=-1)
    wild = replace(full, controller=gain([[1e6], [1e6]], DT))
    with pytest.raises(SynthesisError, match="does not stabilise"):
        reduce_controller(problem, wild)
