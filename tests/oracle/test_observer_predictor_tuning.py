"""Models of hidden states: blocks against plain recursions, tuning against the Kalman predictor, deviation on machines unlike those recorded."""

import numpy as np
import pytest
from batches import batch_of

from kros.lifting import Lifting
from kros.observer import Observer, PastMoments, identify_predictor, run_observer
from kros.observer.predictor.tuning import _slowing, _Tuning, tune_predictor
from kros.observer.tuning.blocks import blocks_of, joined
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
    found = sum(np.tensordot(b.H, b.run(z, z[..., 0])[0], 1) for b in blocks)
    np.testing.assert_allclose(found, recursion(model, z, z[..., 0])[0], rtol=1e-7, atol=1e-9)
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


def test_runs_that_are_kept_and_those_that_are_run_again_give_one_model(monkeypatch):
    x, u = ripple(np.array([1.0, 2.0, 0.5, 1.0]), n_samples=400)
    batch = batch_of(x + np.array([0.3, 0.0]), u, DT, units=list("aabb"))
    past = PastMoments.of(Lifting(("p", "v"), ("sin(5*p)",)), (0,), batch, Basis(5))
    kept = tune_predictor(past.model(4), past, batch, deviation=0.4, iterations=2)
    monkeypatch.setattr("kros.observer.predictor.tuning._KEPT", 0)
    again = tune_predictor(past.model(4), past, batch, deviation=0.4, iterations=2)
    assert np.allclose(kept[1], again[1], rtol=1e-9)
