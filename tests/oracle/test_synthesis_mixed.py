"""Mixed synthesis: the inequalities against Riccati optima and recomputed norms, on general plants and on drive-like
observers."""

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from drives import DT, lag, servo
from scipy.linalg import solve_discrete_lyapunov

from kros.core import StateSpace, block_diagonal, gain, h2_norm, hinf_norm
from kros.core.norms import gramian_root
from kros.synthesis import GeneralizedPlant, Injection, ObserverProblem, h2, mixed
from kros.synthesis.mixed_norms.barrier import minimise
from kros.synthesis.mixed_norms.inequalities import MixedInequalities
from kros.synthesis.mixed_norms.mixed import by_inequalities, scaled, truncate, verify
from kros.synthesis.problem.plants import mixed_plant
from kros.synthesis.worst_case.certificate import certify_errors


def two_channel(rng, n=3, size2=0.3):
    """A random stable plant with w = (w1, noise | w2), z = (performance, penalty | z2)."""
    A = rng.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    B1 = np.hstack([rng.standard_normal((n, 1)), np.zeros((n, 1)), size2 * rng.standard_normal((n, 1))])
    C1 = np.vstack([rng.standard_normal((1, n)), np.zeros((1, n)), size2 * rng.standard_normal((1, n))])
    B2, C2, half = rng.standard_normal((n, 1)), rng.standard_normal((1, n)), 0.5 * np.eye(3)[1:2]
    return GeneralizedPlant(A, B1, B2, C1, C2, np.zeros((3, 3)), half.T, half, [[0.0]], 1.0, n_w1=2, n_z1=2)


def drive_problem(seed, injection, order):
    rng = np.random.default_rng(seed)
    nominal = servo(rng)

    def channel():
        system = lag(10 ** rng.uniform(-2.5, -1.5), 10 ** rng.uniform(-0.9, -0.3), 10 ** rng.uniform(0.5, 2))
        for _ in range(order - 1):
            system = system @ lag(1, 10 ** rng.uniform(-0.2, 0.2), 10 ** rng.uniform(0, 2))
        return system

    return ObserverProblem(
        nominal=nominal,
        C=np.eye(4)[:1],
        W_L=block_diagonal([channel(), channel()]),
        W_R=gain(np.eye(2), DT),
        input_scale=np.array([3.0, 3.0]),
        output_scale=np.array([3.0, 3.0, 0.5, 1.0]),
        noise=np.array([1e-5]),
        n_original=3,
        injection=injection,
    )


def free_optimum(plant):
    """H2 optimum of channel 1 without the constraint, and the norm of T22 that it leaves."""
    found = h2(plant.channel(plant.rows(1), plant.columns(1)))
    return found, hinf_norm(plant.uncertainty.close(found.controller))


def at_level(plant, gamma):
    """The plant whose constraint is one for a level gamma of channel 2."""
    size = np.ones(plant.sizes[3])
    size[plant.rows(2)] = 1 / gamma
    return plant.transformed(z=np.diag(size))


def test_inactive_constraint_gives_the_riccati_optimum():
    """But for the margin of the Lyapunov matrix."""
    for seed in range(2):
        plant = two_channel(np.random.default_rng(seed), size2=1e-4)
        optimum, _ = free_optimum(plant)
        by_lmi = by_inequalities(plant)
        assert optimum.h2_norm * (1 - 1e-9) <= by_lmi.h2_norm <= optimum.h2_norm * 1.01


def test_inequalities_bound_the_norms_and_agree_with_another_solver():
    plant = two_channel(np.random.default_rng(10))
    free, peak = free_optimum(plant)
    gamma = 0.9 * peak
    inequalities = MixedInequalities.of(scaled(at_level(plant, gamma), 16.0))
    own = minimise(inequalities.objective(), inequalities.blocks(), inequalities.start(), rtol=1e-6)
    assert own.value == pytest.approx(by_clarabel(inequalities), rel=1e-4)
    checked = verify(at_level(plant, gamma), inequalities.controller(own.x))
    assert free.h2_norm <= checked.h2_norm <= inequalities.norm * np.sqrt(own.value)
    assert checked.hinf_norm < 1


def by_clarabel(inequalities):
    """Optimum of the inequalities by a conic solver."""
    x = cp.Variable(inequalities.size)
    constraints = []
    for block in inequalities.blocks():
        for constant, basis in zip(block.constant, block.basis.swapaxes(0, 1), strict=True):
            value = cp.reshape(basis.reshape(len(basis), -1).T @ x, constant.shape, order="C") + constant
            constraints.append((value + value.T) / 2 >> 0)
    return cp.Problem(cp.Minimize(inequalities.objective() @ x), constraints).solve(solver="CLARABEL")


@pytest.mark.parametrize(("seed", "order", "injection"), [(3, 4, Injection.INPUT), (5, 1, Injection.STATE)])
def test_drive_like_observers_are_solved_and_certified(seed, order, injection):
    case = drive_problem(seed, injection, order)
    found = mixed(case)
    plant = mixed_plant(case)
    assert plant.sizes[0] == 4 + 2 * order
    K = case.to_scaled(found.controller)
    assert plant.close(K).is_stable()
    assert found.h2_norm == pytest.approx(h2_norm(plant.performance.close(K)), rel=1e-4)
    assert found.hinf_norm == pytest.approx(hinf_norm(case.W_R @ case.W_L), rel=1e-5)  # T22 does not contain K
    assert found.worst_case_h2 == pytest.approx(certify_errors(case, case.error_system(found.controller)))
    nothing = gain(np.zeros((2 if injection is Injection.INPUT else 4, 1)), DT)
    assert found.worst_case_h2 < certify_errors(case, case.error_system(nothing))


def test_splitting_the_weight_differently_changes_nothing():
    """(W_L, W_R) and (W_L / c, c W_R) are the same set, and give the same observer."""
    case = drive_problem(1, Injection.INPUT, 1)
    W = case.W_L
    other = replace(case, W_L=StateSpace(W.A, W.B, W.C / 20, W.D / 20, DT), W_R=gain(20 * np.eye(2), DT))
    one, two = mixed(case), mixed(other)
    assert two.worst_case_h2 == pytest.approx(one.worst_case_h2, rel=1e-2)


def test_mixed_plant_with_dynamic_weights_on_both_sides():
    base = drive_problem(2, Injection.INPUT, 1)
    lagged = block_diagonal([StateSpace([[0.5]], [[1.0]], [[0.2]], [[0.3]], DT)] * 2)
    case = ObserverProblem(
        base.nominal, base.C, base.W_L, lagged, base.input_scale, base.output_scale, base.noise, 3, W_u=lagged
    )
    plant = mixed_plant(case)
    A, B, _, W_p = case.scaled
    freqs = np.geomspace(0.01, 500, 20)
    found = plant.open_loop().frequency_response(freqs)
    right, left = lagged.frequency_response(freqs), base.W_L.frequency_response(freqs)
    z = np.exp(2j * np.pi * freqs * DT)[:, None, None]
    path = W_p @ np.linalg.solve(z * np.eye(4) - A, B[None] + 0j)
    assert found[:, :3, 3:5] == pytest.approx(path @ left, rel=1e-6, abs=1e-9)
    assert found[:, -3:-1, :2] == pytest.approx(right @ right, abs=1e-10)  # W_R W_u
    assert found[:, -3:-1, 3:5] == pytest.approx(right @ left, abs=1e-10)  # W_R W_L
    assert not np.abs(found[:, :3, :3]).any()


def random_plant(rng, n=5):
    A = rng.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    shapes = ((n, 3), (n, 2), (3, n), (2, n), (3, 3), (3, 2), (2, 3))
    return GeneralizedPlant(A, *(rng.standard_normal(s) for s in shapes), 0.1 * rng.standard_normal((2, 2)), 1.0)


@pytest.mark.parametrize("distance", [1e-2, 1e-6, 1e-10])
def test_root_of_the_gramian_keeps_its_digits_near_the_circle(distance):
    a, b = 1 - distance, np.array([[1.0, 0.5]])
    R = gramian_root(np.array([[a]]), b)
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
