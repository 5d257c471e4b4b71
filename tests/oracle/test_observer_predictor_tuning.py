"""Models of hidden states: blocks against plain recursions, tuning against the Kalman predictor, deviation on machines unlike those recorded."""

import numpy as np
import pytest
from batches import batch_of

from kros.lifting import Lifting
from kros.observer import Observer, PastMoments, identify_predictor, run_observer
from kros.observer.predictor.sensitivities import Sensitivities
from kros.observer.predictor.tuning import _slowing, _Tuning, tune_predictor
from kros.observer.tuning.blocks import blocks_of, estimates_along, joined, states_along
from kros.synthesis import Injection, kalman
from kros.synthesis.residual_shaped.shaping_filter import Basis

DT = 0.01


def random_model(order, seed=0):
    rng = np.random.default_rng(seed)
    F = rng.normal(size=(order, order))
    F *= 0.9 / np.abs(np.linalg.eigvals(F)).max()
    return F, rng.normal(size=(order, 3)), rng.normal(size=(2, order))


def recursion(model, z, start):
    F, G, H = model
    h = np.zeros((*z.shape[1:], len(F)))
    h[:, 0] = np.linalg.solve(np.eye(len(F)) - F, G @ start).T
    for k in range(z.shape[2] - 1):
        h[:, k + 1] = h[:, k] @ F.T + z[:, :, k].T @ G.T
    return np.moveaxis(h @ H.T, 2, 0), np.moveaxis(h, 2, 0)


@pytest.mark.parametrize("order", [1, 4, 5])
def test_blocks_estimate_what_the_model_does(order):
    model, z = random_model(order), np.random.default_rng(1).normal(size=(3, 2, 60))
    blocks = blocks_of(*model)
    expected = recursion(model, z, z[..., 0])[0]
    h, held = states_along(blocks, z, z[..., 0])
    np.testing.assert_allclose(estimates_along(blocks, z, z[..., 0]), expected, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(np.tensordot(joined(blocks)[2], h, 1), expected, rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(h[..., 0], held)
    np.testing.assert_array_equal(states_along(blocks, z, z[..., 0], 7)[0], h[..., ::7])
    for power in range(4):
        F, G, H = joined(blocks)
        expected = model[2] @ np.linalg.matrix_power(model[0], power) @ model[1]
        np.testing.assert_allclose(H @ np.linalg.matrix_power(F, power) @ G, expected, rtol=1e-7, atol=1e-9)


def test_delays_are_blocks_too():
    F, G, H = np.eye(4, k=-1), np.eye(4, 3), np.ones((2, 4))
    f, g, h = joined(blocks_of(F, G, H))
    for power in range(5):
        np.testing.assert_allclose(h @ np.linalg.matrix_power(f, power) @ g, H @ np.linalg.matrix_power(F, power) @ G, atol=1e-4)


def test_responses_are_the_derivatives():
    z, step = np.random.default_rng(2).normal(size=(3, 2, 60)), 1e-6
    blocks = blocks_of(*random_model(4))
    F, G, H = joined(blocks)
    before, h = recursion((F, G, H), z, z[..., 0])
    signals, rest = np.concatenate([h, z]), np.concatenate([h[..., 0], z[..., 0]])
    found, thin = (np.concatenate([b.responses(signals, rest, every) for b in blocks]) for every in (1, 7))
    np.testing.assert_array_equal(thin, found[..., ::7])
    for i, j in [(0, 1), (1, 3), (2, 0), (3, 5), (0, 6)]:
        W = np.hstack([F, G])
        W[i, j] += step
        change = (recursion((W[:, :4], W[:, 4:], H), z, z[..., 0])[0] - before) / step
        np.testing.assert_allclose(found[i, j], change, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("order", [1, 4, 5])
def test_few_signals_make_up_all_responses(order):
    rng = np.random.default_rng(5)
    z, rest, blocks = rng.normal(size=(3, 2, 60)), np.vstack([np.zeros((2, 2)), rng.normal(size=(1, 2))]), blocks_of(*random_model(order))
    h, held = states_along(blocks, z, rest)
    expected = np.concatenate([b.responses(np.concatenate([h, z]), np.concatenate([held, rest]), 7) for b in blocks])
    sensitive = Sensitivities(blocks, [2])
    signals = sensitive.signals(z, rest, 7)
    assert len(signals) == 2 * order * 3 + 1
    np.testing.assert_allclose(np.tensordot(sensitive.states, signals, 1), h[..., ::7], rtol=1e-9, atol=1e-9)
    found = np.einsum("oisk,kbt->isobt", sensitive.responses, signals)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_responses_of_slow_poles_keep_their_digits():
    slow = np.array([[0.9995, 2e-4, 0.0], [-2e-4, 0.9995, 0.0], [0.0, 0.0, 0.9999]])
    z, blocks = np.cumsum(np.random.default_rng(6).normal(size=(1, 1, 2000)), axis=-1), blocks_of(slow, np.ones((3, 1)), np.ones((1, 3)))
    F, G, H = (m.astype(np.longdouble) for m in joined(blocks))
    h, S, expected = np.zeros(3, np.longdouble), np.zeros((3, 3, 4), np.longdouble), []
    for value in z[0, 0]:
        expected.append((H[0] @ S.reshape(3, -1)).reshape(3, 4))
        S = (F @ S.reshape(3, -1)).reshape(3, 3, 4)
        S[range(3), range(3)] += np.append(h, value)
        h = F @ h + G[:, 0] * value
    sensitive = Sensitivities(blocks, [])
    found = np.tensordot(sensitive.responses[0], sensitive.signals(z, np.zeros((1, 1)), 1)[:, 0], 1)
    np.testing.assert_allclose(found, np.moveaxis(np.array(expected, float), 0, -1), rtol=0, atol=1e-10 * float(np.abs(expected).max()))


@pytest.mark.parametrize("lifted", [False, True])
def test_curvature_is_that_of_the_responses(lifted):
    rng = np.random.default_rng(7)
    x, u = np.cumsum(rng.normal(size=(400, 6, 3)), axis=0), rng.normal(size=(400, 6, 1))
    batch = batch_of(x, u, DT, units=list("aabbcc"))
    past = PastMoments.of(Lifting(("p", "v", "i"), ("sin(p)",) if lifted else ()), (0,), batch, Basis(4))
    problem = _Tuning(past, batch, 1.0, 0.2, {"": 1.0})
    blocks = blocks_of(*past.model(3))
    into, _ = problem._whitening(problem.at(blocks), None)
    weight = rng.uniform(0.5, 2.0, size=(len(problem.group), 2))
    expected = 0.0
    for part, each in problem.curved:
        h, rest = problem.states(blocks, part, None)
        signals, resting = np.concatenate([h, problem.z[:, part]]), np.concatenate([rest, problem.rest[:, part]])
        inner = np.einsum("isobt,sw->iwobt", np.concatenate([b.responses(signals, resting, 3) for b in blocks]), into)
        direct = np.einsum("op,jbt->ojpbt", np.eye(2), h[..., ::3])
        root = np.sqrt(weight[part].T * each / direct.shape[-1])[..., None]
        X = np.concatenate([(own * root).reshape(-1, direct[0, 0].size) for own in (inner, direct)])
        expected = expected + X @ X.T
    found = problem._curvature(blocks, weight, into, 3)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())


def test_tuning_reaches_the_kalman_predictor_from_a_poor_model():
    rng = np.random.default_rng(3)
    F, G, Q = np.array([[1.0, 0.1], [-0.3, 0.8]]), np.array([[0.0], [1.0]]), np.diag([1e-3, 4e-2])
    x, u = np.zeros((4000, 6, 2)), rng.normal(size=(4000, 6, 1))
    for k in range(3999):
        x[k + 1] = x[k] @ F.T + u[k] @ G.T + rng.normal(size=(6, 2)) * np.sqrt(np.diag(Q))
    plain = Lifting(("x", "v"))
    past = PastMoments.of(plain, (0,), batch_of(x, u, DT), Basis(2))
    _, criterion = tune_predictor(past.model(2), past, batch_of(x, u, DT), least_gain=1e-5)
    best = kalman(F, np.eye(1, 2), Q, np.array([[1e-15]]), DT)
    ideal = Observer("k", plain, F, G, (0,), ("u",), best.controller, Injection.STATE, DT)
    least = np.sqrt(np.mean((run_observer(ideal, x[..., :1], u) - x)[..., 1] ** 2))
    assert np.exp(criterion[-1]) == pytest.approx(least, rel=0.01)
    assert np.exp(criterion[0]) > 1.05 * least


def ripple(shares, seed=0, n_samples=2500):
    """A motor whose torque ripples: its velocity is hidden, and how much it ripples differs from machine to machine."""
    rng, batch = np.random.default_rng(seed), len(shares)
    push = np.cumsum(rng.normal(size=(n_samples, batch)), axis=0)
    push = 0.1 * (push - np.concatenate([np.zeros((100, batch)), push[:-100]]))
    x = np.zeros((n_samples, batch, 2))
    for k in range(n_samples - 1):
        p, v = x[k].T
        x[k + 1, :, 0] = p + DT * v + 1e-5 * rng.normal(size=batch)
        x[k + 1, :, 1] = 0.95 * v + 0.1 * push[k] + 0.05 * shares * np.sin(5 * p) + 0.01 * rng.normal(size=batch)
    return x, push[..., None]


def test_with_deviation_a_machine_unlike_those_recorded_is_estimated_better():
    plain = Lifting(("p", "v"), ("sin(5*p)",))
    x, u = ripple(np.ones(6))
    other, push = ripple(np.full(4, 2.5), seed=1)
    errors = []
    for deviation in (0.0, 0.6):
        observer = identify_predictor(
            "o", plain, (0,), ("push",), batch_of(x, u, DT, units=list("aabbcc")), internal=2, deviation=deviation, iterations=8
        )
        errors.append(np.std((observer.run(other[..., :1], push)[..., :2] - other)[400:, :, 1]))
    assert errors[1] < 0.95 * errors[0]


@pytest.mark.parametrize("seed", range(4))
def test_what_slows_the_slowest_pole_is_the_derivative_of_the_spectral_radius(seed):
    F, step = random_model(4, seed)[0], 1e-7
    radius = np.abs(np.linalg.eigvals(F)).max()
    for i, j in np.ndindex(4, 4):
        moved = F.copy()
        moved[i, j] += step
        change = (np.abs(np.linalg.eigvals(moved)).max() - radius) / step
        assert _slowing(F)[i, j] == pytest.approx(change, rel=1e-4, abs=1e-5)


def test_the_gradient_of_all_samples_is_that_of_differences():
    x, u = ripple(np.array([1.0, 2.0, 0.5, 1.0]), n_samples=400)
    batch = batch_of(x + np.array([0.3, 0.0]), u, DT, units=list("aabb"))
    past = PastMoments.of(Lifting(("p", "v"), ("sin(5*p)",)), (0,), batch, Basis(5))
    tuning = _Tuning(past, batch, 1.0, 0.4, {batch.keys[0].condition: 1.0})
    F, G, H = joined(blocks_of(*past.model(4)))
    n, blocks, step = len(F), blocks_of(F, G, H), 1e-6
    into = np.eye(n + G.shape[1])
    point = tuning.at(blocks)
    found = tuning._gradient(point, None, (tuning.share / point.errors)[tuning.group] * tuning.each[:, None], into)
    assert len(point.errors) == 2  # units count by the logarithms of their own errors
    F, G, H = joined(blocks)
    whole = np.hstack([F, G])
    for k in [*range(0, whole.size, 3), *range(whole.size, whole.size + H.size)]:
        moved = [np.concatenate([whole.ravel(), H.ravel()]) for _ in range(2)]
        moved[0][k] -= step
        moved[1][k] += step
        errors = []
        for values in moved:
            W, h = values[: whole.size].reshape(whole.shape), values[whole.size :].reshape(H.shape)
            error = recursion((W[:, :n], W[:, n:], h), tuning.z, tuning.rest)[0] - tuning.truth
            square = np.zeros((2, 1))
            np.add.at(square, tuning.group, np.mean(error**2, axis=-1).T * tuning.each[:, None])
            errors.append(np.sum(tuning.share * np.log(square)) / 2)
        assert found[k] == pytest.approx(-(errors[1] - errors[0]) / (2 * step), rel=1e-4, abs=1e-6 * np.abs(found).max())
