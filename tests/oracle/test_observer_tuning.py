"""Rows fitted to single steps, tuning on recordings, and the bootstrap over units, against known truths."""

import numpy as np
import pytest
from batches import batch_of

from kros.core.errors import DataError
from kros.core.lti import gain
from kros.evaluate import unit_interval
from kros.lifting import Lifting
from kros.observer import Observer, run_observer
from kros.observer.residual.models import one_step_rows, residual_models
from kros.observer.tuning.observer_rows import tune_observer
from kros.synthesis import Injection, ResidualProblem, kalman, residual_h2

DT = 0.01
LIFTING = Lifting(("x", "v"), ("sin(5*x + phase)",), ("phase",))
A = np.array([[1.0, 0.05, 0.0], [-0.2, 0.9, 0.1], [0, 0, 0]])
B = np.array([[0.0], [0.3], [0.0]])


def recordings(process=0.02, n_samples=1500, batch=4, seed=0):
    """A system with known rows, white process noise and a measurement that is the state itself."""
    rng = np.random.default_rng(seed)
    u, phase = rng.normal(size=(n_samples, batch, 1)), rng.normal(size=batch)
    x = np.zeros((n_samples, batch, 2))
    for k in range(n_samples - 1):
        theta = np.concatenate([x[k], np.sin(5 * x[k, :, :1] + phase[:, None])], axis=-1)
        x[k + 1] = theta @ A[:2].T + u[k] @ B[:2].T + process * rng.normal(size=(batch, 2))
    return x, u, {"phase": phase}


def test_rows_fitted_to_single_steps_are_the_true_ones():
    x, u, phase = recordings(process=0.0)
    found = one_step_rows(LIFTING, batch_of(x, u, DT, phase, [1500, 1500, 1500, 900]))
    np.testing.assert_allclose(found[0], A[:2], atol=1e-9)
    np.testing.assert_allclose(found[1], B[:2], atol=1e-9)


def test_rows_that_help_come_first_and_their_promise_is_kept():
    x, u, phase = recordings()
    wrong = A + np.array([[0, 0.02, 0.05], [0.1, -0.1, 0.0], [0, 0, 0]])
    scale, noise = np.array([1.0, 1.0]), np.array([1e-4])
    models = residual_models(LIFTING, wrong, B, (0,), batch_of(x, u, DT, phase), noise, scale)
    assert [m.refitted for m in models][-1] == ()
    assert sorted(m.refitted for m in models) == [(), (0,), (0, 1)]
    best = models[0]
    assert best.refitted == (0, 1)
    K = residual_h2(ResidualProblem(best.dynamics, np.eye(1, 2), best.spectra, noise, scale, DT), n_lifted=3).controller
    estimate = run_observer(
        Observer("o", LIFTING, best.A, best.B, (0,), ("u",), K, Injection.STATE, DT), x[..., :1], u, phase
    )
    assert np.sqrt(np.mean((estimate - x)[50:, :, 1] ** 2)) == pytest.approx(best.promised[1], rel=0.1)


def test_tuning_finds_the_kalman_filter_of_a_linear_system():
    rng = np.random.default_rng(1)
    plain, F, G = Lifting(("x", "v")), np.array([[1.0, 0.1], [-0.3, 0.8]]), np.array([[0.0], [1.0]])
    Q, R = np.diag([1e-3, 4e-2]), np.array([[1e-3]])
    x, u = np.zeros((4000, 6, 2)), rng.normal(size=(4000, 6, 1))
    for k in range(3999):
        x[k + 1] = x[k] @ F.T + u[k] @ G.T + rng.normal(size=(6, 2)) * np.sqrt(np.diag(Q))
    # The measurement is the recorded state: what is white in the measurement is in the state too, and the Kalman filter for R -> 0 is best.
    best = kalman(F, np.eye(1, 2), Q, 1e-12 * R, DT)
    rough = Observer(
        "o",
        plain,
        F + np.array([[0, 0.02], [0.05, -0.1]]),
        0.9 * G,
        (0,),
        ("u",),
        gain([[0.3], [0.0]], DT),
        Injection.STATE,
        DT,
    )
    tuned, criterion = tune_observer(rough, batch_of(x, u, DT))
    assert list(criterion) == sorted(criterion, reverse=True)
    fresh = np.random.default_rng(2)
    y, w = np.zeros((4000, 6, 2)), fresh.normal(size=(4000, 6, 1))
    for k in range(3999):
        y[k + 1] = y[k] @ F.T + w[k] @ G.T + fresh.normal(size=(6, 2)) * np.sqrt(np.diag(Q))
    ideal = Observer("k", plain, F, G, (0,), ("u",), best.controller, Injection.STATE, DT)
    errors = [np.sqrt(np.mean((run_observer(o, y[..., :1], w) - y)[100:, :, 1] ** 2)) for o in (rough, tuned, ideal)]
    assert errors[1] == pytest.approx(errors[2], rel=0.01)
    assert errors[0] > 1.2 * errors[2]


def test_bootstrap_interval_is_that_of_the_normal_distribution_for_many_units():
    values = np.random.default_rng(3).normal(5.0, 2.0, size=(400, 2))
    lower, upper = unit_interval(values, draws=8000)
    half = 1.96 * values.std(axis=0) / 20
    np.testing.assert_allclose(lower, values.mean(axis=0) - half, atol=0.02)
    np.testing.assert_allclose(upper, values.mean(axis=0) + half, atol=0.02)
    with pytest.raises(DataError, match="at least 2 units"):
        unit_interval([[1.0, 2.0]])
