"""System norms against closed forms, scipy's Lyapunov solver and dense grids."""

import itertools

import mpmath
import numpy as np
import pytest
import scipy.linalg as sl

from kros.core import StateSpace, gain, h2_norm, hinf_norm
from kros.core.norms import precise_gain


def oscillator(zeta, omega):
    return StateSpace([[0, 1], [-(omega**2), -2 * zeta * omega]], [[0], [omega**2]], [[1, 0]], [[0]], 0.0)


def rotation(radius, angle, dt=1e-3):
    A = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return StateSpace(A, [[1], [0]], [[1, 0]], [[0]], dt)


def random_stable(rng, n, dt, m=3, p=2):
    A = rng.standard_normal((n, n))
    radius = np.abs(np.linalg.eigvals(A)).max()
    A = A * rng.uniform(0.3, 1 - 10 ** rng.uniform(-6, -1)) / radius
    if dt == 0:
        A = A - np.eye(n)
    D = rng.standard_normal((p, m)) if dt > 0 else np.zeros((p, m))
    return StateSpace(A, rng.standard_normal((n, m)), rng.standard_normal((p, n)), D, dt)


@pytest.mark.parametrize("pole", [0.0, 0.5, -0.9, 0.999999, -0.999999])
def test_first_order_discrete(pole):
    system = StateSpace([[pole]], [[2.0]], [[3.0]], [[0.0]], 1e-3)
    assert h2_norm(system) == pytest.approx(6 / np.sqrt(1 - pole**2), rel=1e-9)
    assert hinf_norm(system) == pytest.approx(6 / (1 - abs(pole)), rel=1e-9)


@pytest.mark.parametrize("zeta", [0.6, 1e-2, 1e-6])
def test_second_order_continuous(zeta):
    omega = 2 * np.pi * 50
    assert h2_norm(oscillator(zeta, omega)) == pytest.approx(np.sqrt(omega / (4 * zeta)), rel=1e-9)
    assert hinf_norm(oscillator(zeta, omega)) == pytest.approx(1 / (2 * zeta * np.sqrt(1 - zeta**2)), rel=1e-6)


@pytest.mark.parametrize(("gap", "angle"), [(1e-6, 0.3), (1e-9, 1e-3), (1e-7, np.pi - 1e-3), (1e-6, np.pi / 2)])
def test_lightly_damped_discrete_where_a_grid_fails(gap, angle):
    system = rotation(1 - gap, angle)
    local = angle + gap * np.linspace(-5, 5, 20001)
    truth = np.abs(system.frequency_response(local / (2 * np.pi * 1e-3))).max()
    grid = np.abs(system.frequency_response(np.linspace(0, 500, 4001) + 0.0625)).max()
    assert hinf_norm(system) == pytest.approx(truth, rel=2e-6)
    assert grid < 0.5 * truth, "the example should be one where a grid fails"


@pytest.mark.parametrize("dt", [0.0, 1.0, 1e-3])
def test_random_systems_against_a_dense_grid_and_scipy(dt):
    rng = np.random.default_rng(7)
    for _ in range(12):
        system = random_stable(rng, int(rng.integers(1, 11)), dt)
        sizes = np.abs(system.poles() - (dt > 0))
        freqs = np.geomspace(sizes.min() / 30, np.pi if dt > 0 else 30 * sizes.max(), 3000) / (2 * np.pi * (dt or 1))
        grid = np.linalg.norm(system.frequency_response(np.append(freqs, 0)), 2, axis=(-2, -1)).max()
        norm = hinf_norm(system)
        assert grid <= norm * (1 + 2e-6)
        assert norm <= grid * 1.05
        B = system.B @ system.B.T
        P = sl.solve_discrete_lyapunov(system.A, B) if dt > 0 else sl.solve_continuous_lyapunov(system.A, -B)
        assert h2_norm(system) == pytest.approx(
            np.sqrt(np.trace(system.C @ P @ system.C.T) + np.sum(system.D**2)), rel=1e-6
        )


def test_peak_at_nyquist_and_at_dc():
    assert hinf_norm(rotation(0.9, np.pi)) == pytest.approx(10)
    assert hinf_norm(StateSpace(np.diag([0.5, -0.5]), np.eye(2), np.eye(2), np.zeros((2, 2)), 1.0)) == pytest.approx(2)


def test_norms_of_series_agree_with_python_control():
    control = pytest.importorskip("control")
    system = random_stable(np.random.default_rng(11), 4, 1.0, m=2, p=2)
    other = control.ss(system.A, system.B, system.C, system.D, 1.0)
    assert h2_norm(other) == pytest.approx(h2_norm(system))
    assert hinf_norm(other) == pytest.approx(hinf_norm(system))


def test_static_gain():
    matrix = np.array([[3.0, 0.0], [4.0, 0.0]])
    assert hinf_norm(gain(matrix, 1.0)) == pytest.approx(5)
    assert h2_norm(gain(matrix, 1.0)) == pytest.approx(5)
    assert h2_norm(gain(np.zeros((2, 1)), 0.0)) == 0


def stiff_loop(rng, n=4):
    """Slow and resonant modes behind a mode that is ten decades faster, in coordinates that mix them."""
    poles = np.concatenate([-np.exp(rng.uniform(-4, 3, n)), [-np.exp(rng.uniform(18, 24))]])
    A = np.diag(poles)
    A[:2, :2] = np.exp(rng.uniform(-3, 2)) * np.array([[-0.1, 1.0], [-1.0, -0.1]])
    T = np.linalg.qr(rng.standard_normal((n + 1, n + 1)))[0]
    return StateSpace(
        T @ A @ T.T, T @ rng.standard_normal((n + 1, 2)), rng.standard_normal((2, n + 1)) @ T.T, np.zeros((2, 2)), 0.0
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_gain_of_a_stiff_system_is_at_least_what_it_is_anywhere(seed):
    """Against gains of the same matrices in 40 digits, at frequencies around every pole."""
    rng = np.random.default_rng(seed)
    system = stiff_loop(rng)
    found = hinf_norm(system)
    poles, _ = mpmath.eig(mpmath.matrix(system.A.tolist()))
    sizes = np.array(sorted(float(abs(p)) for p in poles))
    omega = np.unique(np.concatenate([np.geomspace(0.3 * s, 3 * s, 25) for s in sizes[:-1]]))
    gains = np.array([precise_gain(system, w / (2 * np.pi)) for w in omega])
    assert found >= gains.max() * (1 - 1e-6)
    assert found <= gains.max() * 1.1  # of a grid


@pytest.mark.parametrize("seed", range(3))
def test_the_h2_norm_of_a_stiff_system_is_exact(seed):
    """Against the Lyapunov equation solved as linear equations in 60 digits."""
    system = stiff_loop(np.random.default_rng(100 + seed), 2)
    n = system.n_states
    with mpmath.workdps(60):
        A, B, C = (mpmath.matrix(m.tolist()) for m in (system.A, system.B, system.C))
        M, Q = mpmath.zeros(n * n), B * B.T
        for i, j, k in itertools.product(range(n), repeat=3):
            M[i * n + j, k * n + j] += A[i, k]
            M[i * n + j, i * n + k] += A[j, k]
        P = mpmath.lu_solve(M, mpmath.matrix([-Q[i, j] for i in range(n) for j in range(n)]))
        squared = sum(C[o, i] * P[i * n + j] * C[o, j] for o in range(2) for i in range(n) for j in range(n))
        exact = float(mpmath.sqrt(squared)) if all(mpmath.re(p) < 0 for p in mpmath.eig(A)[0]) else np.inf
    assert h2_norm(system) == pytest.approx(exact, rel=1e-6)


def test_a_pole_that_rounding_moves_over_the_limit_is_told_in_more_digits():
    """Two slow poles whose real part is 4e-15 of the norm of A: doubles find them unstable."""
    A = np.array([[0.0, 1.0], [-1e-10, -1e-7]])
    found = h2_norm(StateSpace(A, [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]], 0.0))
    assert found == pytest.approx(np.sqrt(1 / (2 * 1e-7 * 1e-10)), rel=1e-9)
    assert h2_norm(StateSpace([[1.0]], [[1.0]], [[1.0]], [[0.0]], 1.0)) == np.inf
