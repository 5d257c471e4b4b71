"""The residual-shaped observer against the optimum that follows from the true shaping filter, and against slow independent code."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from kros.core import StateSpace
from kros.lifting import Lifting
from kros.observer.residual import mean_error_dynamics, mean_slopes, one_step_residual, residual_spectra
from kros.synthesis import Injection, Status, kalman
from kros.synthesis.residual_shaped.residual_h2 import Basis, ResidualProblem, residual_h2, shaping_filter

DT = 1e-2
A = np.array([[1.0, 0.01], [-0.05, 0.95]])
C = np.array([[1.0, 0.0]])
NOISE = np.array([1e-3])
SCALE = np.array([1.0, 2.0])
# Autoregression of order two in two coupled channels, and the factor of its innovation.
PHI = np.array([[[0.5, 0.3], [0.0, 1.6]], [[-0.1, 0.0], [0.0, -0.75]]])
ROOT = np.array([[1e-3, 0.0], [4e-3, 1e-2]])
FREQS = 2049


def autoregression(phi=PHI, root=ROOT):
    top = np.hstack(list(phi))
    dynamics = np.vstack([top, np.eye(2, 4)])
    return StateSpace(dynamics, np.vstack([root, np.zeros((2, 2))]), top, root, DT)


def spectrum(system):
    response = system.frequency_response(np.linspace(0, 0.5 / DT, FREQS))
    return response @ response.conj().swapaxes(-1, -2)


def optimum(system):
    """Gains of the predictor of plant and true filter by SciPy's Riccati solver, and the root mean square of the scaled error."""
    n = len(A)
    augmented = np.block([[A, system.C], [np.zeros((system.n_states, n)), system.A]])
    G, H = np.vstack([system.D, system.B]), np.hstack([C, np.zeros((1, system.n_states))])
    # scaled: SciPy's solver loses small covariances otherwise
    size = 1e-3
    P = solve_discrete_are(augmented.T, H.T, G @ G.T / size**2, np.diag(NOISE**2) / size**2) * size**2
    L = augmented @ P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(NOISE**2))
    return StateSpace(system.A, L[n:], system.C, L[:n], DT), float(np.sqrt(np.sum(np.diag(P)[:n] / SCALE**2)))


def achieved(K, system):
    """Root mean square of the scaled error of an observer under the true filter, by SciPy's Lyapunov solver."""
    n, c, s = len(A), K.n_states, system.n_states
    loop = np.block(
        [
            [A - K.D @ C, -K.C, system.C],
            [K.B @ C, K.A, np.zeros((c, s))],
            [np.zeros((s, n + c)), system.A],
        ]
    )
    drive = np.vstack(
        [
            np.hstack([system.D, -K.D * NOISE]),
            np.hstack([np.zeros((c, 2)), K.B * NOISE]),
            np.hstack([system.B, np.zeros((s, 1))]),
        ]
    )
    P = solve_discrete_lyapunov(loop, drive @ drive.T)
    return float(np.sqrt(np.sum(np.diag(P)[:n] / SCALE**2)))


def simulate(system, n_samples, batch, seed):
    rng = np.random.default_rng(seed)
    state, out = np.zeros((batch, system.n_states)), np.empty((n_samples, batch, 2))
    for k in range(n_samples):
        w = rng.standard_normal((batch, 2))
        out[k] = state @ system.C.T + w @ system.D.T
        state = state @ system.A.T + w @ system.B.T
    return out[500:]


def response(K):
    return K.frequency_response(np.geomspace(0.05, 45, 60))


def test_known_shaping_filter_gives_its_optimum():
    truth = autoregression()
    reference, best = optimum(truth)
    found = residual_h2(
        ResidualProblem(A, C, spectrum(truth)[None], NOISE, SCALE, DT, Basis(2, ())), tolerance_percent=0
    )
    assert (found.status, found.injection, found.method) == (Status.OPTIMAL, Injection.STATE, "residual_h2")
    assert found.h2_norm == pytest.approx(best, rel=1e-5)
    assert achieved(found.controller, truth) == pytest.approx(best, rel=1e-5)
    np.testing.assert_allclose(
        response(found.controller), response(reference), rtol=1e-4, atol=1e-4 * np.abs(response(reference)).max()
    )


def test_measured_residual_gives_nearly_that_optimum():
    truth = autoregression()
    reference, best = optimum(truth)
    omega = simulate(truth, 20500, 8, seed=1)
    spectra = residual_spectra(omega, [len(omega)] * 8, ["a"] * 4 + ["b"] * 4)
    found = residual_h2(ResidualProblem(A, C, spectra, NOISE, SCALE, DT), tolerance_percent=0)
    # 160 000 samples: parameters of an autoregression are known to 1/400, the loss is of second order.
    assert best <= achieved(found.controller, truth) < 1.01 * best
    error = np.abs(response(found.controller) - response(reference))
    assert error.max() < 0.06 * np.abs(response(reference)).max()


def test_white_residual_gives_the_ordinary_kalman_gain():
    Q = ROOT @ ROOT.T
    flat = np.broadcast_to(Q + 0j, (1, FREQS, 2, 2))
    found = residual_h2(ResidualProblem(A, C, flat, NOISE, SCALE, DT))
    ordinary = kalman(A, C, Q, np.diag(NOISE**2), DT)
    assert found.controller.n_states == 0
    np.testing.assert_allclose(found.controller.D, ordinary.controller.D, rtol=1e-6)


def test_reduction_costs_what_it_says():
    truth = autoregression()
    shaped = spectrum(truth)[None]
    full = residual_h2(ResidualProblem(A, C, shaped, NOISE, SCALE, DT), tolerance_percent=0)
    small = residual_h2(ResidualProblem(A, C, shaped, NOISE, SCALE, DT), tolerance_percent=1)
    assert small.controller.n_states < 6 < full.controller.n_states
    assert 0 <= small.gap_percent <= 1
    assert small.h2_norm == pytest.approx(achieved(small.controller, truth), rel=1e-4)
    assert small.lower_bound == pytest.approx(achieved(full.controller, truth), rel=1e-4)


def test_lifted_rows_are_not_corrected():
    found = residual_h2(ResidualProblem(A, C, spectrum(autoregression())[None], NOISE, SCALE, DT), n_lifted=5)
    assert found.controller.n_outputs == 5
    assert not found.controller.C[2:].any()
    assert not found.controller.D[2:].any()


@pytest.mark.parametrize("basis", [Basis(1, ()), Basis(8, ()), Basis(0, (0.5, 0.99)), Basis(3, (0.9, -0.5, 0.999))])
def test_shaping_filters_are_stable_for_any_spectrum(basis):
    rng = np.random.default_rng(3)
    for _ in range(5):
        root = rng.standard_normal((65, 3, 3)) * np.exp(3 * rng.standard_normal((65, 1, 1))) + 0j
        root[1:-1] += 1j * rng.standard_normal((63, 3, 3))
        assert shaping_filter(root @ root.conj().swapaxes(-1, -2), basis, DT).is_stable()


def test_spectra_integrate_to_covariances_of_each_unit():
    rng = np.random.default_rng(4)
    omega = rng.standard_normal((30000, 3, 2)) @ ROOT.T * np.array([1.0, 2.0, 2.0])[:, None] + 0.01
    spectra = residual_spectra(omega, [30000, 30000, 20000], ["b", "a", "a"], segment=1000)
    assert spectra.shape == (2, 501, 2, 2)
    weight = np.full(501, 1 / 500)
    weight[[0, -1]] /= 2
    second = np.full((2, 2), 0.01**2)
    for found, factor in zip(np.einsum("f,ufij->uij", weight, spectra).real, (1.0, 4.0), strict=True):
        np.testing.assert_allclose(found, factor * ROOT @ ROOT.T + second, rtol=0.05, atol=1e-6)


def test_samples_behind_the_end_of_an_episode_do_not_count():
    omega = np.random.default_rng(5).standard_normal((4000, 2, 2))
    spoiled = omega.copy()
    spoiled[2500:, 1] = 1e6
    lengths = [4000, 2500]
    assert np.array_equal(residual_spectra(omega, lengths, "ab", 500), residual_spectra(spoiled, lengths, "ab", 500))


@pytest.mark.parametrize(
    "lifting",
    [
        Lifting(("x", "v")),
        Lifting(("x", "v"), ("sin(3*x + phase)",), ("phase",)),
        Lifting(("x", "v"), ("x[-2]*v",), (), ("u",), ("u*v",)),
    ],
    ids=["linear", "sine", "delays and input functions"],
)
def test_one_step_residual_sample_by_sample(lifting):
    rng = np.random.default_rng(6)
    states, inputs, phase = rng.standard_normal((40, 3, 2)), rng.standard_normal((40, 3, 1)), rng.uniform(size=3)
    p, m = lifting.n_lifted, 1 + len(lifting.input_functions)
    dynamics, B = rng.standard_normal((p, p)), rng.standard_normal((p, m))
    values = {"phase": phase} if lifting.parameters else None
    found = one_step_residual(lifting, dynamics, B, states, inputs, values)
    h = lifting.history
    assert found.shape == (39 - h, 3, 2)
    for b in range(3):
        for k in range(h, 39):
            x, v, u = states[k, b, 0], states[k, b, 1], inputs[k, b, 0]
            if not lifting.functions:
                theta, upsilon = [x, v], [u]
            elif lifting.parameters:
                theta, upsilon = [x, v, np.sin(3 * x + phase[b])], [u]
            else:
                theta, upsilon = [x, v, states[k - 2, b, 0] * v], [u, u * v]
            expected = states[k + 1, b] - (dynamics @ theta + B @ upsilon)[:2]
            np.testing.assert_allclose(found[k - h, b], expected, rtol=1e-10, atol=1e-12)


def test_mean_error_dynamics_by_differences():
    lifting = Lifting(("x", "v"), ("sin(3*x + phase)", "x*v"), ("phase",))
    rng = np.random.default_rng(7)
    states, inputs, values = rng.standard_normal((50, 2, 2)), np.zeros((50, 2, 1)), {"phase": np.array([0.2, 1.0])}
    dynamics = rng.standard_normal((4, 4))
    found = mean_error_dynamics(dynamics, mean_slopes(lifting, states, inputs, values))
    step = 1e-6
    for i in range(2):
        moved = states + step * np.eye(2)[i]
        difference = (
            (lifting.lift(moved, values) - lifting.lift(states - step * np.eye(2)[i], values))
            @ dynamics[:2].T
            / (2 * step)
        )
        np.testing.assert_allclose(found[:, i], difference.mean(axis=(0, 1)), rtol=1e-6)
