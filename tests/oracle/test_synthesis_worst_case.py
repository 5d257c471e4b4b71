"""Worst-case H2: the certificate against brute force, quadrature against closed forms, the design against a game by
hand."""

import numpy as np
import pytest
from drives import DT, lag, servo
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize

from kros.core import StateSpace, block_diagonal, gain, h2_norm
from kros.synthesis import Injection, ObserverProblem, Status, worst_case_h2
from kros.synthesis.worst_case.ball import Ball, dual_bound
from kros.synthesis.worst_case.certificate import certify_errors, circle_mean, density
from kros.synthesis.worst_case.worst_case_h2 import filters
from kros.uncertainty import fit_magnitude


def problem(seed=0, injection=Injection.STATE, **changes):
    rng = np.random.default_rng(seed)
    nominal = servo(rng)
    parts = {
        "nominal": nominal,
        "C": np.eye(4)[:1],
        "W_L": block_diagonal(
            [
                lag(10 ** rng.uniform(-2.5, -1.5), 10 ** rng.uniform(-0.9, -0.3), 10 ** rng.uniform(0.5, 2))
                for _ in range(2)
            ]
        ),
        "W_R": gain(np.diag([1.0, rng.uniform(0.3, 1)]), DT),
        "input_scale": np.array([3.0, 3.0]),
        "output_scale": np.array([3.0, 3.0, 0.5, 1.0]),
        "noise": np.array([1e-4]),
        "n_original": 3,
        "injection": injection,
    }
    return ObserverProblem(**{**parts, **changes})


def contraction(x, m):
    """A unitary matrix from 2 m^2 real numbers (extreme points of the contractions)."""
    U, _, Vh = np.linalg.svd((x[: m * m] + 1j * x[m * m :]).reshape(m, m))
    return U @ Vh


@pytest.mark.parametrize("shape", [(1, 2), (2, 1), (3, 2), (3, 1)])
def test_the_set_is_a_matrix_ball_of_any_shape(shape):
    """Loops with more or fewer rows than columns: members are inside, and what is inside are members."""
    rng, (a, b) = np.random.default_rng(1), shape
    for _ in range(10):
        N = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
        N *= rng.uniform(0.3, 0.9) / np.linalg.norm(N, 2)
        ball = Ball.of(N[None], np.eye(a)[None])
        free = rng.standard_normal((b, a)) + 1j * rng.standard_normal((b, a))
        delta = free / np.linalg.norm(free, 2)
        X = delta @ np.linalg.inv(np.eye(a) - N @ delta)
        assert (
            np.linalg.norm(np.linalg.solve(ball.left[0], X - ball.center[0]) @ np.linalg.inv(ball.right[0]), 2)
            <= 1 + 1e-9
        )
        X = ball.center[0] + ball.left[0] @ delta @ ball.right[0]
        assert np.linalg.norm(X @ np.linalg.inv(np.eye(a) + N @ X), 2) <= 1 + 1e-9


def test_dual_bound_against_optimised_contractions():
    rng = np.random.default_rng(5)
    for m, p in ((1, 1), (1, 3), (2, 1), (2, 4), (3, 2)):
        a, P, Q = (
            (rng.standard_normal(s) + 1j * rng.standard_normal(s)) @ np.diag(10 ** rng.uniform(-1.5, 0, m))
            for s in ((p, m), (p, m), (m, m))
        )

        def size(x, a=a, P=P, Q=Q, m=m):
            return -np.linalg.norm(a + P @ contraction(x, m) @ Q)

        found = -min(minimize(size, rng.standard_normal(2 * m * m)).fun for _ in range(3))
        bound = dual_bound(a[None], P[None], Q[None])[0]
        assert found * (1 - 1e-9) <= bound <= found * 1.05
        sizes = [np.linalg.svd(side, compute_uv=False) for side in (P, Q)]
        largest = np.linalg.norm(np.prod([one[: min(map(len, sizes))] for one in sizes], axis=0))
        assert dual_bound(0 * a[None], P[None], Q[None])[0] == pytest.approx(largest)


@pytest.mark.parametrize(
    "pole", [0.5, 0.999, 0.9999999, 0.999 * np.exp(0.3j), 0.9999999 * np.exp(1e-3j), 0.999999 * np.exp(3.0j)]
)
def test_quadrature_over_many_decades(pole):
    # |1 / (z - p)|^2 and its mirror image have mean 1 / (1 - |p|^2).
    def power(theta):
        zeta = np.expm1(1j * theta)
        return (np.abs(zeta - (pole - 1)) ** -2 + np.abs(zeta - (np.conj(pole) - 1)) ** -2) / 2

    mean, error = circle_mean(power, np.log(np.array([pole + 0j])), 1e-8)
    truth = 1 / (1 - abs(pole) ** 2)
    assert abs(mean - truth) <= max(error, 1e-9 * truth) + 1e-9 * truth
    assert error <= 1e-7 * truth


def test_error_system_is_the_formula():
    for injection in Injection.INPUT, Injection.STATE:
        case = problem(1, injection)
        A, B, C, W_p = case.scaled
        K = gain(np.linspace(0.01, 0.04, case.nothing.n_outputs)[:, None], DT)
        freqs = np.array([0.01, 1.0, 30.0, 400.0])
        loop = case.error_system(K).frequency_response(freqs)
        J = B if injection is Injection.INPUT else np.eye(4)
        for f, z in enumerate(np.exp(2j * np.pi * freqs * DT)):
            R = np.linalg.inv(z * np.eye(4) - A)
            k = case.to_scaled(K).frequency_response(freqs[[f]])[0]
            S = np.linalg.inv(np.eye(4) + R @ J @ k @ C)
            assert loop[f][:, :7] == pytest.approx(
                W_p @ S @ np.hstack([R @ B, np.eye(4), -R @ J @ k]), rel=1e-6, abs=1e-9
            )


@pytest.mark.parametrize("seed", [0, 1])
def test_certificate_covers_random_members_of_the_set(seed):
    """Simulate the definition itself: random plants G (I - W_L Delta W_R)^-1 per frequency, error density summed over
    a fine grid."""
    case = problem(seed)
    found = worst_case_h2(case)
    assert found.status is Status.CERTIFIED
    assert found.lower_bound <= found.worst_case_h2
    assert found.gap_percent < 20
    rng = np.random.default_rng(seed)
    theta = np.geomspace(1e-6, np.pi, 3000)
    freqs = theta / (2 * np.pi * DT)
    loop = case.error_system(found.controller)
    response = loop.frequency_response(freqs)
    left, right = case.W_L.frequency_response(freqs), case.W_R.frequency_response(freqs)
    bound = density(case, loop, freqs)
    noise = np.sum(np.abs(response[..., 6:]) ** 2, axis=(-2, -1))
    highest = np.zeros_like(noise)
    for _ in range(30):
        delta = contraction(rng.standard_normal(8), 2)
        E = left @ delta @ right
        error = response[..., :2] @ np.linalg.solve(np.eye(2) - E, E)
        power = np.sum(np.abs(error) ** 2, axis=(-2, -1)) + noise
        assert np.all(power <= bound * (1 + 1e-9))
        assert np.sqrt(np.trapezoid(power, theta) / np.pi) <= found.worst_case_h2 * 1.001
        highest = np.maximum(highest, power)
    assert np.sqrt(np.trapezoid(bound, theta) / np.pi) == pytest.approx(found.worst_case_h2, rel=2e-3)
    assert np.sqrt(np.trapezoid(highest, theta) / np.pi) > 0.7 * found.worst_case_h2


def test_exact_when_the_set_is_a_scaled_identity():
    """W_L = w I with scalar constants: the worst spectrum is white of size (w / (1 - w))^2, so the Kalman filter for
    it is the answer."""
    w = 0.3
    case = problem(2, W_L=gain(w * np.eye(2), DT), W_R=gain(np.eye(2), DT))
    found = worst_case_h2(case, max_order=0)
    A, B, C, W_p = case.scaled
    P = solve_discrete_are(A.T, C.T, (w / (1 - w)) ** 2 * B @ B.T, np.eye(1))
    L = np.linalg.solve(np.eye(1) + C @ P @ C.T, C @ P @ A.T).T
    optimum = certify_errors(case, case.error_system(case.to_physical(gain(L, DT))))
    assert optimum == pytest.approx(np.sqrt(np.trace(W_p @ P @ W_p.T)), rel=1e-4)
    assert optimum <= found.worst_case_h2 <= 1.001 * optimum, "a design for the average spectrum, not the worst one"
    assert found.gap_percent < 0.05
    assert found.controller.n_states == 0


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.7, np.pi])
def test_a_certificate_sees_resonances_that_a_grid_passes_over(angle):
    """A scalar perturbation of the input: the worst case is the norm of the plant, whose whole energy is in a band of a
    ten-millionth of the range."""
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    A = (1 - 1e-7) * turn if np.sin(angle) > 1e-9 else np.diag([(1 - 1e-7) * np.cos(angle), 0.5])
    nominal = StateSpace(A, [[0.5], [0.2]], np.eye(2), np.zeros((2, 1)), 1.0)
    weights, scales = (gain([[0.01]], 1.0), gain([[1.0]], 1.0)), ([1.0], [1.0, 1.0], [0.1])
    case = ObserverProblem(nominal, [[1.0, 0.0]], *weights, *scales, form="input_multiplicative")
    nothing = gain(np.zeros((2, 1)), 1.0)
    value = certify_errors(case, case.error_system(nothing))
    assert value == pytest.approx(0.01 * h2_norm(nominal), rel=1e-4)


def test_shaping_filters_touch_their_spectra_from_above():
    freqs = np.geomspace(1e-3, 0.5 / DT, 400)
    corner = freqs[:, None] / np.array([20.0, 3.0])
    phi = np.array([4.0, 1e-6]) / (1 + corner**2) + np.array([0.01, 2e-9])
    response = filters(phi, freqs, DT, 3, 0.5).frequency_response(freqs)
    ratio = np.abs(np.diagonal(response, axis1=1, axis2=2)) ** 2 / phi
    np.testing.assert_allclose(ratio.min(axis=0), 1.0, rtol=1e-9)
    overbounds = [fit_magnitude(freqs, np.sqrt(c), DT, max_order=3, tolerance_db=0.5).overbound_db for c in phi.T]
    np.testing.assert_allclose(10 * np.log10(ratio.max(axis=0)), overbounds, atol=0.05)
