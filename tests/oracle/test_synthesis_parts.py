"""Parts of worst-case synthesis, one by one: multipliers, bounding spectra and quadrature against what each is by definition."""

from importlib import import_module

import numpy as np
import pytest
from scipy.optimize import minimize

from kros.core import StateSpace, gain, h2_norm, hinf_norm
from kros.synthesis import ObserverProblem, worst_case_hinf
from kros.synthesis.worst_case.certificate import certify
from kros.synthesis.worst_case.disturbance import Channels, design_grid
from kros.synthesis.worst_case.robust_gain import _Constraint, robust_gain
from kros.synthesis.worst_case.worst_case_hinf import dominating

DT = 1.0


def scalar_problem(w_left=0.3, **changes):
    parts = {
        "nominal": StateSpace([[0.8]], [[0.5]], [[1.0]], [[0.0]], DT),
        "C": [[1.0]],
        "W_L": gain([[w_left]], DT),
        "W_R": gain([[1.0]], DT),
        "input_scale": [1.0],
        "output_scale": [1.0],
        "noise": [0.1],
    }
    return ObserverProblem(**{**parts, **changes})


@pytest.mark.parametrize("constraints", [1, 2])
def test_multipliers_are_the_best_there_are(constraints):
    """Against a simplex search on the formula of the module, and, for one number each, the triangle inequality."""
    rng = np.random.default_rng(constraints)

    def matrix(*shape):
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    f = 6
    case = _Constraint(
        matrix(f, 2, 3), tuple(0.7 * matrix(f, 2, 2) for _ in range(constraints)), tuple(matrix(f, 2, 2) for _ in range(constraints))
    )

    def bound(log_tau, k):
        inner, outer = np.eye(2, dtype=complex), np.zeros((3, 3), complex)
        for tau, P, Q in zip(np.exp(log_tau), case.P, case.Q, strict=True):
            inner = inner - P[k] @ P[k].conj().T / tau
            outer[:2, :2] += tau * Q[k].conj().T @ Q[k]
        if np.linalg.eigvalsh(inner)[0] <= 0:
            return np.inf
        return np.linalg.eigvalsh(case.A[k].conj().T @ np.linalg.solve(inner, case.A[k]) + outer)[-1]

    found, point = case.best()
    for k in range(f):
        assert found[k] ** 2 == pytest.approx(bound(point[k], k), rel=1e-9)
        starts = point[k] + rng.normal(scale=0.5, size=(6, constraints)) + 0.5
        least = min(
            minimize(bound, s, args=(k,), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 4000}).fun
            for s in starts
            if np.isfinite(bound(s, k))
        )
        assert np.sqrt(least) * (1 - 1e-9) <= found[k] <= np.sqrt(least) * 1.0005
    one = _Constraint(matrix(f, 1, 1), tuple(matrix(f, 1, 1) for _ in case.P), tuple(matrix(f, 1, 1) for _ in case.P))
    truth = np.abs(one.A[:, 0, 0]) + sum(np.abs(P * Q)[:, 0, 0] for P, Q in zip(one.P, one.Q, strict=True))
    assert one.best()[0] == pytest.approx(truth, rel=1e-6)


def test_the_dominating_spectrum_of_one_channel_is_the_largest_of_the_set():
    """One input: multipliers make the bound exact, ``(w / (1 - w))^2`` whatever the frequency; a remainder shares the level with it."""
    case = scalar_problem()
    channels = Channels(case, design_grid(case))
    loop = case.error_system(gain([[0.3]], DT))
    spectrum = dominating(channels, loop)
    assert spectrum.psi is None
    assert spectrum.phi[:, 0] == pytest.approx((0.3 / 0.7) ** 2, rel=1e-9)

    case = scalar_problem(remainder_left=gain([[0.2]], DT), remainder_right=gain([[0.5]], DT))
    channels = Channels(case, design_grid(case))
    loop = case.error_system(gain([[0.3]], DT))
    spectrum, response = dominating(channels, loop), loop.frequency_response(channels.freqs_hz)
    at_input, at_state = response[:, 0, 0], response[:, 0, 1]
    total = np.abs(at_input) ** 2 * spectrum.phi[:, 0] + np.abs(at_state) ** 2 * spectrum.psi[:, 0]
    assert total == pytest.approx((np.abs(at_input) * 0.3 / 0.7 + np.abs(at_state) * 0.1) ** 2, rel=1e-9)  # the gain from w1, attained


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.7, np.pi])
def test_a_certificate_sees_resonances_that_a_grid_passes_over(angle):
    """No uncertainty: what is left is the norm of the loop, whose whole energy is in a band of a ten-millionth of the range."""
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    A = (1 - 1e-7) * turn if np.sin(angle) > 1e-9 else np.diag([(1 - 1e-7) * np.cos(angle), 0.5])
    nominal = StateSpace(A, [[0.5], [0.2]], np.eye(2), np.zeros((2, 1)), DT)
    case = ObserverProblem(
        nominal, [[1.0, 0.0]], gain([[0.0]], DT), gain([[0.0]], DT), [1.0], [1.0, 1.0], [0.1], process_noise=[0.01, 0.02]
    )
    nothing = gain(np.zeros((2, 1)), DT)
    value, error = certify(case, nothing)
    loop = case.error_system(nothing)
    assert value == pytest.approx(h2_norm(StateSpace(loop.A, loop.B[:, 3:], loop.C, loop.D[:, 3:], DT)), rel=1e-4)  # noises alone
    assert error < 1e-3 * value


def test_a_gain_is_attained_where_it_is_said_to_be():
    """Scalars: the worst case at a frequency is ``|T| w / (1 - w)`` beside the noise; the largest is at a resonance between the points of any grid."""
    angle, radius = 1.234, 1 - 1e-4
    turn = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    nominal = StateSpace(turn, [[0.5], [0.0]], np.eye(2), np.zeros((2, 1)), DT)
    case = ObserverProblem(nominal, [[1.0, 0.0]], gain([[0.2]], DT), gain([[1.0]], DT), [1.0], [1.0, 1.0], [0.1])
    found = robust_gain(case, gain(np.zeros((2, 1)), DT))
    theta = angle + np.linspace(-5e-4, 5e-4, 20001)
    response = case.error_system(gain(np.zeros((2, 1)), DT)).frequency_response(theta / (2 * np.pi))
    size = np.linalg.norm(response[:, :, 0], axis=1) * 0.2 / 0.8
    assert found.attained == pytest.approx(size.max(), rel=1e-4)
    assert found.freq_hz == pytest.approx(theta[size.argmax()] / (2 * np.pi), rel=1e-5)
    assert found.attained <= found.value <= 1.0011 * found.attained


def test_rounds_after_the_first_make_the_design_for_the_gain_no_worse():
    case = scalar_problem(W_L=StateSpace([[0.9]], [[1.0]], [[0.02]], [[0.05]], DT))
    first, more = (worst_case_hinf(case, refinements=rounds, bounded=False) for rounds in (0, 2))
    assert more.worst_case_hinf <= first.worst_case_hinf * (1 + 1e-9)
    loop = case.error_system(more.controller)
    assert more.hinf_norm == pytest.approx(hinf_norm(StateSpace(loop.A, loop.B[:, 2:], loop.C, loop.D[:, 2:], DT)))  # of the noise alone
    nothing = robust_gain(case, gain([[0.0]], DT))
    assert more.worst_case_hinf < nothing.value


def test_a_gain_between_all_points_that_were_looked_at_raises_the_level(monkeypatch):
    """One point beside a broad resonance is looked at first: the walk meets the top by itself, and claims hardly more than that is attained."""
    angle, radius = 1.234, 0.8
    turn = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    nominal = StateSpace(turn, [[0.5], [0.0]], np.eye(2), np.zeros((2, 1)), DT)
    case = ObserverProblem(nominal, [[1.0, 0.0]], gain([[0.2]], DT), gain([[1.0]], DT), [1.0], [1.0, 1.0], [0.1])
    nothing = gain(np.zeros((2, 1)), DT)
    truth = robust_gain(case, nothing)
    module = import_module("kros.synthesis.worst_case.robust_gain")
    monkeypatch.setattr(module, "_first_grid", lambda *_: np.array([0.0, 0.7 * angle / (2 * np.pi), 0.5 / DT]))
    monkeypatch.setattr(module, "_ROUNDS", 0)
    found = robust_gain(case, nothing)
    assert found.attained <= truth.value
    assert truth.attained <= found.value <= 1.06 * truth.attained
    assert found.value == pytest.approx(found.attained, rel=0.051)
