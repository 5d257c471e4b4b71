"""The running observer against textbook filters, delayed truth, and the phase of a simulated drive."""

import numpy as np
import pytest
from batches import track_parameter
from random_models import random_observer

from kros.core.errors import ConfigError, DataError, DimensionError
from kros.core.lti import gain
from kros.lifting import Lifting
from kros.observer import Observer, Runtime, run_observer
from kros.synthesis import Injection, kalman

DT = 0.001
LIFTING = Lifting(("position", "velocity", "current"), ("sin(10*position + phase)",), ("phase",))


def observer(lifting=LIFTING, runtime=None, order=2, m=2):
    return random_observer(lifting, order=order, inputs=("a", "b")[:m], runtime=runtime or Runtime())


def recordings(m=2, n_samples=40, batch=2, seed=1):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n_samples, batch, 1)), rng.normal(size=(n_samples, batch, m))


def test_filtered_estimate_of_a_kalman_predictor_is_the_kalman_filter():
    F, G, C = np.array([[0.9, 0.2], [-0.1, 0.8]]), np.array([[0.0], [1.0]]), np.eye(1, 2)
    Q, R = np.diag([0.1, 0.3]), np.array([[0.2]])
    o = Observer("k", Lifting(("x", "v")), F, G, (0,), ("u",), kalman(F, C, Q, R, DT).controller, Injection.STATE, DT)
    P = np.eye(2)
    for _ in range(3000):  # the covariance recursion, to its steady state
        gain_now = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        P = F @ (P - gain_now @ C @ P) @ F.T + Q
    np.testing.assert_allclose(o.filter_gain, gain_now, atol=1e-9)
    y, u = recordings(m=1)
    x = run_observer(o, y, u)
    filtered = x + (y - x[..., :1]) @ gain_now.T
    running = o.start(y[0, 0])
    for k in range(len(y)):
        np.testing.assert_allclose(running.filter(y[k, 0]), filtered[k, 0], atol=1e-9)
        running.step(y[k, 0], u[k, 0])
    # predicting from the filtered state is the prediction
    np.testing.assert_allclose(x[1:], filtered[:-1] @ F.T + u[:-1] @ G.T, atol=1e-9)


def test_a_late_measurement_of_an_exact_model_costs_nothing():
    F, G = np.array([[1.0, 0.01], [-0.5, 0.95]]), np.array([[0.0], [1.0]])
    plain, K = Lifting(("x", "v")), gain([[0.6], [5.0]], DT)
    u, x = np.random.default_rng(4).normal(size=(400, 1, 1)), np.zeros((400, 1, 2))
    for k in range(399):
        x[k + 1] = x[k] @ F.T + u[k] @ G.T
    late = np.concatenate([np.repeat(x[:1, :, :1], 7, axis=0), x[:-7, :, :1]])
    wrong = Observer("o", plain, F, G, (0,), ("u",), K, Injection.STATE, DT)
    right = Observer("o", plain, F, G, (0,), ("u",), K, Injection.STATE, DT, runtime=Runtime(delay=7))
    np.testing.assert_allclose(run_observer(right, late, u), x, atol=1e-9)
    assert np.abs(run_observer(wrong, late, u) - x).max() > 0.1


def test_a_runtime_that_makes_no_sense_is_refused():
    with pytest.raises(DataError, match="whole number"):
        Runtime(delay=-1)
    with pytest.raises(DataError, match="should not exceed"):
        Runtime(lower=[1.0], upper=[0.0])
    with pytest.raises(DataError, match="lower should be numbers"):
        Runtime(lower=[np.nan])
    with pytest.raises(DimensionError, match=r"runtime.lower should have shape \(3,\)"):
        observer(runtime=Runtime(lower=[1.0]))


def test_phase_locked_loop_finds_the_phase_in_both_directions():
    """Drives that turn at a speed while the gearbox shakes them; the measurement is the position."""
    lifting = Lifting(("position", "velocity"), ("sin(100*position + phase)",), ("phase",))
    A, B = np.array([[1.0, DT, 0.0], [0.0, 0.97, 0.02], [0, 0, 0]]), np.array([[0.0], [0.03], [0.0]])
    speeds, off, true = np.array([2.0, 2.0, -2.0, -2.0]), np.array([1.0, -1.0, 1.0, -1.0]), 0.7
    rng, u = np.random.default_rng(0), np.broadcast_to(speeds[:, None], (3000, 4, 1))
    x = np.zeros((3000, 4, 2))
    x[0, :, 1] = speeds
    for k in range(2999):
        x[k + 1] = (
            lifting.lift(x[k], {"phase": true}) @ A[:2].T + u[k] @ B[:2].T + 1e-3 * rng.normal(size=(4, 2)) * [0, 1]
        )
    K = kalman(A[:2, :2], np.eye(1, 2), np.diag([1e-12, 1e-6]), np.array([[1e-11]]), DT).controller
    o = Observer("o", lifting, A, B, (0,), ("u",), gain(np.vstack([K.D, [[0.0]]]), DT), Injection.STATE, DT)
    tracked = track_parameter(o, x[..., :1], u, {"phase": true + off}, settle_s=0.3)
    np.testing.assert_allclose(tracked.followed[0], true + off)
    np.testing.assert_allclose(tracked.followed[2000:].mean(axis=0), true, atol=0.05)
    running = o.start(x[0, 0, :1], phase=true + off[0])
    running.track("phase", settle_s=0.3)
    sampled = [np.asarray(running.step(*sample)) for sample in zip(x[:300, 0, :1], u[:, 0], strict=False)]
    np.testing.assert_allclose(sampled[:-1], tracked.estimates[1:300, 0], rtol=1e-12)
    as_at_first = run_observer(o, x[..., :1], u, {"phase": true + off})
    assert np.all(
        np.std((tracked.estimates - x)[2000:, :, 1], axis=0) < 0.7 * np.std((as_at_first - x)[2000:, :, 1], axis=0)
    )


def test_what_cannot_be_followed_is_refused():
    y, u = recordings()
    with pytest.raises(ConfigError, match="'angle'"):
        track_parameter(observer(), y, u, name="angle")
    with pytest.raises(ConfigError, match="a delay of 2"):
        track_parameter(observer(runtime=Runtime(2)), y, u)


def test_a_caller_may_use_its_arrays_again():
    """Inputs wait for late measurements, and the last good one stands for those that are missing."""
    y, u = (part[:60, 0].copy() for part in recordings())
    u[30:33] = np.nan
    fresh, again = (observer(runtime=Runtime(2)).start(y[0]) for _ in range(2))
    place = np.empty(u.shape[1])
    for k in range(len(y)):
        place[...] = u[k]
        np.testing.assert_array_equal(np.asarray(again.step(y[k], place)), np.asarray(fresh.step(y[k], u[k])))
