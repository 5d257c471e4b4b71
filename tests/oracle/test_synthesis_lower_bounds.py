"""Lower bounds of worst-case designs against observers that are there: none may lie above what somebody attains."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from kros.core import StateSpace, block_diagonal, gain
from kros.synthesis import Injection, ObserverProblem, worst_case_h2
from kros.synthesis.result import enclosed
from kros.synthesis.riccati.h2 import predictor_bound
from kros.synthesis.worst_case.certificate import certify_errors
from kros.synthesis.worst_case.worst_case_h2 import member, shifts

DT = 1.0
FULL = StateSpace([[0.6]], [[1.0, 0.3]], [[0.1], [0.05]], [[0.2, 0.1], [0.0, 0.2]], DT)


def stored(name):
    """A problem from its matrices."""
    parts = json.loads((Path(__file__).parent / "data" / f"{name}.json").read_text())
    for key, value in parts.items():
        if isinstance(value, dict):
            parts[key] = StateSpace(*(value[k] for k in "ABCD"), value["dt"])
    return ObserverProblem(**{**parts, "injection": Injection(parts["injection"])})


def resonance(radius, angle, size=1.0, feed=0.0):
    """One lightly damped mode with a peak of about `size` above `feed`."""
    A = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return StateSpace(A, [[1.0], [0.0]], [[0.0, 2 * size * (1 - radius)]], [[feed]], DT)


def small_problem(**changes):
    parts = {
        "nominal": StateSpace([[0.9, 0.1], [0.0, 0.7]], [[0.0], [0.5]], np.eye(2), np.zeros((2, 1)), DT),
        "C": [[1.0, 0.0]],
        "W_L": gain([[0.3]], DT),
        "W_R": gain([[1.0]], DT),
        "input_scale": [1.0],
        "output_scale": [1.0, 1.0],
        "noise": [0.1],
    }
    return ObserverProblem(**{**parts, **changes})


def others(problem, found, rng, count=6):
    """Observers that are not the one found: perturbed, and none."""
    K = found.controller
    yield gain(np.zeros_like(K.D), K.dt)
    for size in np.geomspace(0.01, 0.5, count):
        other = StateSpace(
            K.A,
            K.B * (1 + size * rng.standard_normal(K.B.shape)),
            K.C,
            K.D + size * np.abs(K.D).max() * rng.standard_normal(K.D.shape),
            K.dt,
        )
        if problem.error_system(other).is_stable():
            yield other


# --- the population whose bound was above what is attained


def test_a_lightly_damped_population():
    """An open-loop observer guarantees 24.81, whatever the order of the shaping filters; the bound lies below, and is
    worth something."""
    case = stored("lightly_damped_population")
    nothing = certify_errors(case, case.error_system(gain(np.zeros((4, 1)), case.nominal.dt)))
    assert nothing == pytest.approx(24.81, abs=0.005)
    found = worst_case_h2(case)
    assert found.worst_case_h2 <= nothing
    assert 0.7 * nothing < found.lower_bound < found.worst_case_h2
    assert found.gap_percent == pytest.approx(100 * (found.worst_case_h2 / found.lower_bound - 1))


# --- the error of the optimal filter


def random_model(rng, n=5, k=4, q=2, spread=0.0):
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.3, 0.99) / np.abs(np.linalg.eigvals(A)).max()
    T = np.diag(10.0 ** rng.uniform(-spread, spread, n))
    B, C = rng.standard_normal((n, k)), rng.standard_normal((q, n))
    D = np.hstack([rng.standard_normal((q, k - q)) * 0.3, np.eye(q)])
    Z = rng.standard_normal((3, n))
    return T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), D, Z @ np.linalg.inv(T)


@pytest.mark.parametrize("spread", [0.0, 5.0])
def test_the_least_error_is_the_optimum_in_all_units(spread):
    rng = np.random.default_rng(1)
    for _ in range(10):
        plain = random_model(rng)
        A, B, C, D, Z = plain
        P = solve_discrete_are(A.T, C.T, B @ B.T, D @ D.T, s=B @ D.T)
        optimum = np.trace(Z @ P @ Z.T)
        T = np.diag(10.0 ** rng.uniform(-spread, spread, len(A)))
        proven = predictor_bound(T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), D, Z @ np.linalg.inv(T))
        assert proven == pytest.approx(optimum, rel=1e-9)


TWO = block_diagonal([resonance(0.99, 1.0, 0.3, 0.1), gain([[0.2]], DT)])
REST = gain([[0.1, 0.05], [0.0, 0.1]], DT)


# --- whole designs


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"W_L": resonance(0.999, 1.3, 0.4, 0.1)},
        {"form": "input_multiplicative", "W_R": resonance(0.995, 0.7, 2.0, 0.2)},
        {"form": "additive", "W_L": TWO, "W_R": gain([[1.0], [0.5]], DT)},
        {"form": "inverse_output_multiplicative", "W_L": FULL, "W_R": gain(np.eye(2), DT)},
        {"remainder_left": REST, "remainder_right": gain([[1.0]], DT), "W_L": gain([[0.01]], DT)},
    ],
    ids=["plain", "resonant", "resonant chain", "additive", "full weight", "correlated remainder"],
)  # fmt: skip
def test_no_observer_is_below_the_bound(changes):
    case = small_problem(**changes)
    found = worst_case_h2(case, max_order=1)
    assert 0.4 * found.worst_case_h2 < found.lower_bound <= found.worst_case_h2
    rng = np.random.default_rng(0)
    for K in others(case, found, rng):
        assert certify_errors(case, case.error_system(K)) >= found.lower_bound


# --- what is handed on


def test_a_bound_above_what_is_attained_is_never_a_result():
    lower, gap, notes = enclosed(2.0, 2.1)
    assert lower is None
    assert gap is None
    assert "2.1 above the attained 2" in notes[0]
    assert enclosed(2.0, None)[:2] == (None, None)
    assert enclosed(2.0, 1.0) == (1.0, 100.0, ())
    assert enclosed(0.0, None) == (0.0, None, ())
    assert enclosed(1.0, 1.0 + 1e-9) == (1.0, 0.0, ())


# --- the members behind the bound


@pytest.mark.parametrize(
    "changes",
    [
        {"W_R": resonance(0.9, 1.0, 0.8, 0.2)},
        {"form": "additive", "W_L": TWO, "W_R": gain([[1.0], [0.5]], DT)},
        {"form": "inverse_additive", "W_L": resonance(0.98, 1.1, 0.2, 0.1), "W_R": gain([[0.3, 0.1]], DT)},
    ],
)
def test_members_are_plants_of_the_set(changes):
    """The response of a member from its definition; the constant perturbation behind it is a contraction."""
    case, freqs = small_problem(**changes), np.linspace(0.01, 0.5, 7)
    for delta in shifts(case.W_L.n_inputs, case.W_R.n_outputs):
        assert np.linalg.norm(delta, 2) <= 1
        loop = np.eye(delta.shape[1]) + 0j * freqs[:, None, None]
        loop = loop - case.N.frequency_response(freqs) @ delta
        seen = np.linalg.solve(loop, case.M.frequency_response(freqs))
        expected = case.W_L.frequency_response(freqs) @ delta @ seen
        assert member(case, delta).frequency_response(freqs) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("pole", [1.0, 1.02, 3.0])
def test_a_state_that_grows_but_is_seen_has_a_bound(pole):
    """One unstable state, measured with noise: the scalar Riccati equation has a closed form, whatever drives the
    machine."""
    q, r = 0.3, 0.7  # variances of what drives the state and of the measurement
    b = r * (1 - pole**2) - q
    error = (-b + np.sqrt(b**2 + 4 * q * r)) / 2  # p = pole^2 p r / (p + r) + q
    found = predictor_bound(
        np.array([[pole]]),
        np.array([[np.sqrt(q), 0.0]]),
        np.ones((1, 1)),
        np.array([[0.0, np.sqrt(r)]]),
        np.array([[1.0]]),
    )
    assert found == pytest.approx(error, rel=1e-9)
