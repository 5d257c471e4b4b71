"""H-infinity synthesis against published optima, closed forms, coprime-factor theory and a slow linear matrix
inequality."""

import cvxpy as cp
import numpy as np
import pytest
from scipy.linalg import null_space, solve_continuous_are, solve_discrete_are
from slicot import partition, slicot_discrete

from kros.core import StateSpace, hinf_norm
from kros.synthesis import GeneralizedPlant, Status, h2, hinf


def coprime(A, B, C, dt):
    """Robust stabilisation of normalised coprime factors as a four-block problem: w1 at the input, w2 at the output, z
    = (y, u)."""
    n, m, p = len(A), B.shape[1], C.shape[0]
    inputs, outputs = np.hstack([B, np.zeros((n, p)), B]), np.vstack([C, np.zeros((m, n)), C])
    zero, one = np.zeros((p, m)), np.eye(p)
    through = np.block([[zero, one, zero], [np.zeros((m, m + p)), np.eye(m)], [zero, one, zero]])
    return partition(A, inputs, outputs, through, p, m, dt)


def random_plant(rng, n, dt):
    A, n_w, n_u, n_z, n_y = rng.standard_normal((n, n)), 3, int(rng.integers(1, 3)), 3, int(rng.integers(1, 3))
    shapes = ((n, n_w), (n, n_u), (n_z, n), (n_y, n), (n_z, n_w), (n_z, n_u), (n_y, n_w))
    return GeneralizedPlant(A, *(rng.standard_normal(s) for s in shapes), 0.1 * rng.standard_normal((n_y, n_u)), dt)


def slow_optimum(p):
    """Optimum by the projected bounded-real inequalities (Gahinet and Apkarian, 1994), solved by an interior-point
    method."""
    n, n_w, _, n_z, _ = p.sizes
    R, S, gamma = cp.Variable((n, n), symmetric=True), cp.Variable((n, n), symmetric=True), cp.Variable()

    def projected(A, B1, C1, D11, N, P, n_in):
        if p.dt > 0:
            head = cp.bmat([[A @ P @ A.T - P, A @ P @ C1.T], [C1 @ P @ A.T, C1 @ P @ C1.T]])
        else:
            head = cp.bmat([[A @ P + P @ A.T, P @ C1.T], [C1 @ P, np.zeros((len(C1), len(C1)))]])
        E = np.diag(np.r_[np.zeros(n), np.ones(len(C1))])
        G = np.vstack([B1, D11])
        whole = cp.bmat([[N.T @ (head - gamma * E) @ N, N.T @ G], [G.T @ N, -gamma * np.eye(n_in)]])
        return (whole + whole.T) / 2 << 0

    constraints = [
        projected(p.A, p.B1, p.C1, p.D11, null_space(np.hstack([p.B2.T, p.D12.T])), R, n_w),
        projected(p.A.T, p.C1.T, p.B1.T, p.D11.T, null_space(np.hstack([p.C2, p.D21])), S, n_z),
        cp.bmat([[R, np.eye(n)], [np.eye(n), S]]) >> 0,
    ]
    problem = cp.Problem(cp.Minimize(gamma), constraints)
    problem.solve(solver="CLARABEL")
    return float(problem.value), problem.status


def test_slicot_discrete_level():
    # The example asks for 111.294, which is its optimum to all six digits.
    found = hinf(slicot_discrete()[0])
    assert found.status is Status.OPTIMAL
    assert found.hinf_norm == pytest.approx(111.294, abs=1e-3)


def test_zhou_doyle_glover_h2_example():
    # Robust and Optimal Control, example 19.1.
    A, B2 = [[-1, 0, 4], [0, 2, 0], [0, 0, -3]], [1, 1, 1]
    B = [[0, 0, B2[0]], [1, 0, B2[1]], [0, 0, B2[2]]]
    plant = partition(A, B, np.array(B).T, [[0, 0, 0], [0, 0, 1], [0, 1, 0]], 1, 1, 0.0)
    found = h2(plant)
    assert found.h2_norm == pytest.approx(8.9582, abs=5e-5)
    assert hinf(plant).hinf_norm < hinf_norm(plant.close(found.controller))


def test_octave_example_whose_optimum_is_zero():
    # One-block problem with a minimum-phase plant: T = 0 is reached, K = -1 / (s + 3) (Octave's hinfsyn).
    found = hinf(partition([[-1]], [[1, 1]], [[1], [1]], [[0, 1], [1, 0]], 1, 1, 0.0))
    assert found.hinf_norm == pytest.approx(0, abs=1e-8)
    assert found.status is Status.OPTIMAL
    K = found.controller.frequency_response([0.0, 1.0]).ravel()
    assert pytest.approx(-1 / (2j * np.pi * np.array([0.0, 1.0]) + 3), abs=1e-6) == K


@pytest.mark.parametrize(("pole", "zero"), [(0.5, 2.0), (-0.5, 1.25), (0.9, -3.0)])
def test_interpolation_in_discrete_time(pole, zero):
    # W = 1 / (z - pole), Theta = (z - zero) / (1 - zero z): the optimum is |W(zero)|.
    b = 1 / zero
    A, B1, B2 = np.diag([pole, b]), [[1.0], [0.0]], [[0.0], [1.0]]
    # (z - zero)/(1 - zero z) = -b (z - zero)/(z - b) = -b - b (b - zero)/(z - b)
    plant = GeneralizedPlant(A, B1, B2, [[1.0, -b * (b - zero)]], [[0.0, 0.0]], [[0.0]], [[-b]], [[1.0]], [[0.0]], 1.0)
    found = hinf(plant)
    assert found.hinf_norm == pytest.approx(abs(1 / (zero - pole)), rel=2e-5)
    assert found.lower_bound <= abs(1 / (zero - pole)) * (1 + 1e-9)


@pytest.mark.parametrize("a", [-1.0, 0.0, 2.0])
def test_scalar_output_feedback_closed_form(a):
    # dx = a x + w1 + u, z = (x, u), y = x + w2: X = Y, and X = gamma in 2 a X + X^2 (1/gamma^2 - 1) + 1 = 0.
    plant = GeneralizedPlant(
        [[a]], [[1.0, 0]], [[1.0]], [[1.0], [0]], [[1.0]], np.zeros((2, 2)), [[0], [1.0]], [[0, 1.0]], [[0]], 0.0
    )
    assert hinf(plant).hinf_norm == pytest.approx(a + np.sqrt(a**2 + 2), rel=2e-5)


@pytest.mark.parametrize("dt", [0.0, 1e-3])
def test_normalised_coprime_factors(dt):
    # Glover and McFarlane (1989): the optimum is sqrt(1 + rho(X Z)) with the two LQG Riccati solutions, for any order
    # and size.
    rng = np.random.default_rng(7)
    solve = solve_discrete_are if dt > 0 else solve_continuous_are
    for _ in range(8):
        n, m, p = int(rng.integers(1, 9)), int(rng.integers(1, 4)), int(rng.integers(1, 4))
        A, B, C = rng.standard_normal((n, n)), rng.standard_normal((n, m)), rng.standard_normal((p, n))
        X, Z = solve(A, B, C.T @ C, np.eye(m)), solve(A.T, C.T, B @ B.T, np.eye(p))
        expected = np.sqrt(1 + np.abs(np.linalg.eigvals(X @ Z)).max())
        found = hinf(coprime(A, B, C, dt))
        assert found.status is Status.OPTIMAL
        assert found.hinf_norm == pytest.approx(expected, rel=2e-5)
        assert found.lower_bound <= expected * (1 + 1e-7)


@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")  # what the slow solver is not sure of is not compared
@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_slow_inequality_finds_the_same_optimum(dt):
    rng = np.random.default_rng(11)
    compared = 0
    for _ in range(5):
        plant = random_plant(rng, int(rng.integers(1, 4)), dt)
        slow, status = slow_optimum(plant)
        found = hinf(plant)
        assert found.hinf_norm == pytest.approx(hinf_norm(plant.close(found.controller)), rel=1e-9)
        if status == "optimal":
            compared += 1
            assert found.hinf_norm == pytest.approx(slow, rel=1e-3)
    assert compared >= 4


def test_static_optimum_is_parrotts():
    empty = (np.zeros(shape) for shape in ((0, 0), (0, 2), (0, 1), (2, 0), (1, 0)))
    plant = GeneralizedPlant(*empty, [[1, 2], [3, 4]], [[0], [1]], [[0, 1]], [[0.5]], 1.0)
    found = hinf(plant)
    assert found.hinf_norm == pytest.approx(np.sqrt(10), rel=2e-5)  # the larger of the first row and the first column
    assert found.controller.n_states == 0
    assert found.status is Status.OPTIMAL


@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_a_wide_tolerance_gives_a_norm_within_it(dt):
    plant = random_plant(np.random.default_rng(4), 4, dt)
    best = hinf(plant)
    found = hinf(plant, tolerance=0.3)
    assert best.lower_bound <= found.hinf_norm <= 1.3 * found.lower_bound * (1 + 2e-6)
    assert found.lower_bound <= best.hinf_norm
    assert np.isfinite(best.spectral_radius)
    assert best.spectral_radius < (1 if dt > 0 else 0)


@pytest.mark.parametrize(("gap", "angle"), [(1e-6, 0.3), (1e-7, np.pi - 1e-3), (1e-6, np.pi / 2)])
def test_lightly_damped_open_loop_where_a_grid_fails(gap, angle):
    # The resonance is not measured, so the optimum is its peak, 1e6 and more, in a band of 1e-6 rad.
    A = (1 - gap) * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    B1, zero = np.array([[1.0, 0], [0, 0]]), np.zeros((2, 2))
    plant = GeneralizedPlant(
        A, B1, [[1.0], [0]], [[1.0, 0], [0, 0]], [[0.0, 0]], zero, [[0], [1.0]], [[0, 1.0]], [[0]], 1.0
    )
    local = (angle + gap * np.linspace(-5, 5, 20001)) / (2 * np.pi)
    open_loop = StateSpace(A, B1[:, :1], [[1.0, 0]], [[0.0]], 1.0)
    truth = np.abs(open_loop.frequency_response(local)).max()
    assert hinf(plant).hinf_norm == pytest.approx(truth, rel=1e-5)
    assert np.abs(open_loop.frequency_response(np.linspace(0, 0.5, 4001) + 0.0000625)).max() < 0.5 * truth, (
        "a grid should fail"
    )


@pytest.mark.parametrize("seed", [1, 2, 11])
def test_bounds_hold_in_all_coordinates(seed):
    """Slow poles that disturbances hardly reach, in units of measure of many sizes: no bound lies above what another
    frame attains."""
    rng = np.random.default_rng(seed)
    n, faint = 10, 1e-6
    A = np.diag(np.concatenate([[1 - 1e-6, 1 - 1e-6, 1 - 1e-5], rng.uniform(-0.9, 0.99, n - 3)]))
    B1, B2 = np.hstack([rng.standard_normal((n, 2)), np.zeros((n, 1))]), rng.standard_normal((n, 1))
    C1, C2 = np.vstack([rng.standard_normal((1, n)), np.zeros((1, n))]), rng.standard_normal((1, n))
    B1[:3] *= faint
    found = []
    for units in (np.ones(n), np.where(np.arange(n) < 3, faint, 1.0), np.geomspace(1, 1e5, n)):
        plant = GeneralizedPlant(
            A * units / units[:, None], B1 / units[:, None], B2 / units[:, None], C1 * units, C2 * units,
            np.zeros((2, 3)), [[0.0], [1.0]], [[0.0, 0.0, 1.0]], [[0.0]], 1.0,
        )  # fmt: skip
        found.append(hinf(plant))
    assert max(f.lower_bound for f in found) <= min(f.hinf_norm for f in found) * (1 + 1e-5)  # where the search ends


def test_close_solves_the_algebraic_loop():
    rng = np.random.default_rng(8)
    plant = GeneralizedPlant(
        *(rng.standard_normal(s) for s in ((3, 3), (3, 2), (3, 1), (2, 3), (2, 3), (2, 2), (2, 1), (2, 2))),
        0.3 * rng.standard_normal((2, 1)),
        1.0,
    )
    K = StateSpace(*map(rng.standard_normal, ((2, 2), (2, 2), (1, 2), (1, 2))), 1.0)
    freqs = np.array([0.01, 0.1, 0.37])
    P, k = plant.open_loop().frequency_response(freqs), K.frequency_response(freqs)
    P11, P12, P21, P22 = P[:, :2, :2], P[:, :2, 2:], P[:, 2:, :2], P[:, 2:, 2:]
    expected = P11 + P12 @ k @ np.linalg.solve(np.eye(2) - P22 @ k, P21)
    assert plant.close(K).frequency_response(freqs) == pytest.approx(expected)
