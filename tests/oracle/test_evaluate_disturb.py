"""Disturbed measurements: what an observer makes of them has an answer on paper where the observer is linear."""

import numpy as np
import pytest

from kros.core.lti import StateSpace, gain
from kros.core.norms import gramian
from kros.data import EpisodeBatch
from kros.data.batch import hold_missing
from kros.data.population import EpisodeKey
from kros.evaluate.disturb import (
    Disturbance,
    Kind,
    Measured,
    disturbed_errors,
    disturbed_rows,
    standard_disturbances,
)
from kros.evaluate.errors import error_percent
from kros.lifting import Lifting
from kros.observer import Observer
from kros.observer.baselines.extended_kalman import ExtendedKalman
from kros.observer.simulate import run_observers
from kros.synthesis import Injection

LINEAR = Lifting(("x", "v"))
LIFTED = Lifting(("x", "v"), ("sin(3*x + phase)",), ("phase",))
A, B, L = np.array([[1.0, 0.1], [-0.05, 0.9]]), np.array([[0.0], [0.1]]), np.array([[0.5], [0.4]])


def observer(lifting=LINEAR, L=L):
    n = lifting.n_lifted
    grown = np.zeros((n, n))
    grown[:2, :2] = A
    grown[:2, 2:] = 0.02
    pad = ((0, n - 2), (0, 0))
    return Observer(
        "test", lifting, grown, np.pad(B, pad), (0,), ("u",), gain(np.pad(L, pad), 0.01), Injection.STATE, 0.01
    )


def plant(n_samples=3000, batch=4, seed=0):
    """A machine that is the model, exactly: all errors come from the measurement."""
    rng = np.random.default_rng(seed)
    u, x = rng.normal(size=(n_samples, batch, 1)), np.zeros((n_samples, batch, 2))
    for k in range(n_samples - 1):
        x[k + 1] = x[k] @ A.T + u[k] @ B.T
    return x, u


def measured(x, phases=None):
    y = np.ascontiguousarray(x[..., :1])
    return Measured(y, {} if phases is None else {"phase": phases}, np.abs(y).max(axis=(0, 1)))


def test_a_bias_shifts_the_estimate_by_what_the_predictor_makes_of_a_constant():
    x, u = plant()
    given = measured(x)
    biased = given.under([Disturbance(Kind.BIAS, 0.1)])
    error = (run_observers([observer()], biased.y, u)[0] - x)[-1]
    C, bias = np.array([[1.0, 0.0]]), 0.1 * given.size
    expected = np.linalg.solve(np.eye(2) - A + L @ C, L @ bias)  # e+ = (A - L C) e + L b
    np.testing.assert_allclose(error, np.broadcast_to(expected, error.shape), rtol=1e-8)


def test_noise_gives_the_error_that_the_lyapunov_equation_promises():
    x, u = plant(20_000, 6)
    given = measured(x)
    noisy = given.under([Disturbance(Kind.NOISE, 0.05)], seed=3)
    error = (run_observers([observer()], noisy.y, u)[0] - x)[500:]
    C = np.array([[1.0, 0.0]])
    covariance = gramian(A - L @ C, L * 0.05 * given.size, 0.01)
    np.testing.assert_allclose(np.mean(error**2, axis=(0, 1)), np.diag(covariance), rtol=0.03)


def test_losing_everything_is_the_open_loop():
    x, u = plant(300)
    lost = measured(x).under([Disturbance(Kind.DROPPED, 1.0)])
    assert np.isfinite(lost.y[0]).all()
    assert np.isnan(lost.y[1:]).all()
    o = observer(LIFTED)
    open_loop = observer(LIFTED, 0 * L)
    phases = {"phase": np.linspace(0, 3, x.shape[1])}
    y = lost.y.copy()
    y[0] = x[0, :, :1]
    np.testing.assert_allclose(
        run_observers([o], y, u, phases)[0],
        run_observers([open_loop], measured(x).y, u, phases)[0],
        rtol=1e-12,
        atol=1e-12,
    )


def test_many_observers_with_missing_samples_do_what_each_does_by_itself_sample_by_sample():
    x, u = plant(400)
    rng = np.random.default_rng(5)
    K = StateSpace(
        0.3 * rng.normal(size=(2, 2)),
        rng.normal(size=(2, 1)),
        0.1 * rng.normal(size=(3, 2)),
        0.3 * rng.normal(size=(3, 1)),
        0.01,
    )
    first = observer(LIFTED)
    second = Observer("memory", LIFTED, first.A, first.B, (0,), ("u",), K, Injection.STATE, 0.01)
    given = measured(x, np.arange(4.0)).under([Disturbance(Kind.DROPPED, 0.3), Disturbance(Kind.GAP, 20)])
    u = np.tile(u, (1, 2, 1))
    together = run_observers([first, second], given.y, u, given.parameters)
    for o, estimate in zip((first, second), together, strict=True):
        x, x_c, K = o.initial(given.y[0]), np.zeros((u.shape[1], o.controller.n_states)), o.controller
        for k, (y_k, u_k) in enumerate(zip(given.y, u, strict=True)):
            np.testing.assert_allclose(estimate[k], x, rtol=1e-9, atol=1e-12)
            nu = np.where(np.isfinite(y_k), y_k - x[:, :1], 0.0)
            x = (LIFTED.lift(x, given.parameters) @ o.A.T + u_k @ o.B.T + x_c @ K.C.T + nu @ K.D.T)[:, :2]
            x_c = x_c @ K.A.T + nu @ K.B.T


def test_the_extended_filter_without_measurements_is_the_kalman_recursion_without_its_update():
    x, u = plant(80, 3)
    Q, R, P0 = 0.01 * np.eye(2), np.array([[0.04]]), np.diag([0.04, 4.0])
    y = measured(x).under([Disturbance(Kind.DROPPED, 0.4)], seed=1).y
    found = ExtendedKalman(LINEAR, A, B, (0,), ("u",), Q, R, P0).run(y, u)
    for i in range(3):
        state, P = np.array([y[0, i, 0], 0.0]), P0
        for k in range(len(y)):
            np.testing.assert_allclose(found[k, i], state, rtol=1e-9, atol=1e-12)
            if np.isfinite(y[k, i, 0]):
                gains = P[:, :1] / (P[0, 0] + R[0, 0])
                state, P = state + gains[:, 0] * (y[k, i, 0] - state[0]), P - gains @ P[:1]
            state, P = A @ state + B @ u[k, i], A @ P @ A.T + Q


def test_every_kind_does_what_its_name_says():
    x, _ = plant(5000)
    given = measured(x, np.zeros(4))
    low, high, gaps = (
        given.under([d], 2).y[..., 0]
        for d in (Disturbance(Kind.DROPPED, 0.1), Disturbance(Kind.DROPPED, 0.4), Disturbance(Kind.GAP, 50))
    )
    share = [np.isnan(y).mean() for y in (low, high, gaps)]
    np.testing.assert_allclose(share, [0.1, 0.4, 0.1], atol=0.01)
    assert np.all(np.isnan(high[np.isnan(low)]))  # what is lost at 10 % is lost at 40 %
    for column in gaps.T:
        edges = np.flatnonzero(np.diff(np.concatenate([[0], np.isnan(column), [0]])))
        lengths = edges[1::2] - edges[::2]
        assert np.all(lengths % 50 == 0)
        assert 9 <= len(lengths) <= 10
    rounded = given.under([Disturbance(Kind.QUANTISATION, 0.01)]).y
    assert np.abs(rounded - given.y).max() <= 0.005 * given.size[0] * (1 + 1e-9)
    late = given.under([Disturbance(Kind.DELAY, 7)]).y
    np.testing.assert_array_equal(late[7:], given.y[:-7])
    np.testing.assert_array_equal(late[:7], np.broadcast_to(given.y[0], late[:7].shape))
    wrong = given.under([Disturbance(Kind.PHASE, 0.5), Disturbance(Kind.BIAS, 0.0)])
    np.testing.assert_array_equal(wrong.parameters["phase"], [0.5] * 4 + [0.0] * 4)
    np.testing.assert_array_equal(wrong.y, np.concatenate([given.y, given.y], axis=1))
    still = measured(0 * x)
    for kind in (Kind.QUANTISATION, Kind.NOISE, Kind.BIAS):
        np.testing.assert_array_equal(
            still.under([Disturbance(kind, 0.1)]).y, still.y
        )  # shares of no range are nothing


def test_holding_takes_the_last_measurement_that_arrived():
    rng = np.random.default_rng(0)
    y = rng.normal(size=(200, 3, 2))
    y[rng.random(y.shape) < 0.5] = np.nan
    held, last = hold_missing(y), np.zeros((3, 2))
    for k in range(len(y)):
        last = np.where(np.isfinite(y[k]), y[k], last)
        np.testing.assert_array_equal(held[k], last)


def test_errors_over_severity_are_of_every_episode_channel_and_disturbance():
    x, u = plant(600)
    keys = tuple(EpisodeKey(unit, "default", "0") for unit in "abcd")
    batch = EpisodeBatch(keys, np.array([600, 600, 500, 600]), x, u, 0.01, {"phase": np.zeros(4)})
    disturbances = standard_disturbances([Kind.DROPPED, Kind.NOISE, Kind.DELAY])
    observers = [observer(LIFTED), observer(LIFTED, 0.5 * L)]

    def run(keys, y, u, values):
        return (run_observers([one], y, u, values) for one in observers)

    first, second = disturbed_errors(batch, (0,), disturbances, run)
    assert first.shape == second.shape == (1 + len(disturbances), 4, 2)
    rows = list(disturbed_rows(first, disturbances, {0: "x", 1: "v"}))
    assert len(rows) == 2 * (1 + len(disturbances))
    plain = next(r for r in rows if (r["disturbance"], r["channel"]) == ("none", "v"))["error_percent"]
    (estimate,) = run_observers(observers[:1], batch.measurements([0]), u, {"phase": np.zeros(4)})
    alone = error_percent(estimate[..., :2], x, batch.lengths)
    np.testing.assert_allclose(first[0], alone, rtol=1e-12)
    assert plain == {"mean": pytest.approx(alone[:, 1].mean()), "worst": pytest.approx(alone[:, 1].max())}
    (lost,) = disturbed_rows(np.full((1, 4, 2), np.inf), [], {1: "v"})
    assert lost["error_percent"] == {"mean": None, "worst": None}
