"""Wrong and lost measurements: what a linear observer makes of them has an answer on paper."""

from dataclasses import replace

import numpy as np
import pytest

from kros.core.lti import StateSpace, gain
from kros.lifting import Lifting
from kros.observer import Observer
from kros.observer.baselines.difference import hold_missing
from kros.observer.sensor_gains import sensor_gains
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


def lost(x, share, seed=0):
    """Measurements of x of which a share is lost, the first one excepted."""
    y = np.ascontiguousarray(x[..., :1])
    gone = np.random.default_rng(seed).random(y.shape[:2]) < share
    gone[0] = False
    return np.where(gone[..., None], np.nan, y)


@pytest.mark.parametrize("sizes", [{"x": 1.0, "v": 1.0}, {"x": 0.25, "v": 8.0}])
def test_gains_are_what_an_error_of_the_measurement_costs(sizes):
    """An offset for ever, white noise, and the bounded error that is worst for a state."""
    o, (x, u), C = observer(), plant(20_000, 1), np.array([[1.0, 0.0]])
    gains, own = sensor_gains(o, sizes)["x"], A - L @ C  # e+ = (A - L C) e + L n
    impulse = np.array([np.linalg.matrix_power(own, k) @ L for k in range(500)])[::-1, :, 0]

    def error(wrong):
        n = len(wrong)
        return (next(run_observers([o], x[:n, :, :1] + wrong[:, None, None], u[:n])) - x[:n])[:, 0]

    offset, noise = error(np.ones(500))[-1], error(np.random.default_rng(3).normal(size=len(x)))[500:].std(axis=0)
    for i, state in enumerate("xv"):
        size = sizes["x"] / sizes[state]
        worst = error(np.append(np.sign(impulse[:, i]), 0.0))[-1, i]
        assert gains["bias"][state] == pytest.approx(abs(offset[i]) * size, rel=1e-8)
        assert gains["noise"][state] == pytest.approx(noise[i] * size, rel=0.03)
        assert gains["bounded"][state] == pytest.approx(worst * size, rel=1e-5)


def test_an_observer_that_forgets_nothing_or_too_slowly_has_no_gains():
    sizes = {"x": 1.0, "v": 1.0}
    assert sensor_gains(observer(L=np.array([[0.0], [1.0]])), sizes) == {}
    slow = replace(observer(L=np.array([[0.0], [0.1]])), A=np.diag([1 - 1e-7, 0.9]))
    assert sensor_gains(slow, sizes) == {}
    assert sensor_gains(replace(slow, A=np.diag([1 - 1e-3, 0.9])), sizes)


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
    y, phases = lost(x, 0.3), {"phase": np.arange(4.0)}
    y[50:70] = np.nan
    together = run_observers([first, second], y, u, phases)
    for o, estimate in zip((first, second), together, strict=True):
        x, x_c, K = o.initial(y[0]), np.zeros((u.shape[1], o.controller.n_states)), o.controller
        for k, (y_k, u_k) in enumerate(zip(y, u, strict=True)):
            np.testing.assert_allclose(estimate[k], x, rtol=1e-9, atol=1e-12)
            nu = np.where(np.isfinite(y_k), y_k - x[:, :1], 0.0)
            x = (LIFTED.lift(x, phases) @ o.A.T + u_k @ o.B.T + x_c @ K.C.T + nu @ K.D.T)[:, :2]
            x_c = x_c @ K.A.T + nu @ K.B.T


def test_holding_takes_the_last_measurement_that_arrived():
    rng = np.random.default_rng(0)
    y = rng.normal(size=(200, 3, 2))
    y[rng.random(y.shape) < 0.5] = np.nan
    held, last = hold_missing(y), np.zeros((3, 2))
    for k in range(len(y)):
        last = np.where(np.isfinite(y[k]), y[k], last)
        np.testing.assert_array_equal(held[k], last)
