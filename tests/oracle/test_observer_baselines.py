"""Baselines against what is known without them: textbook recursions, analytic filters, an estimator that is linear in the past."""

from dataclasses import replace

import numpy as np
import pytest
from batches import batch_of

import kros
from kros.core.errors import DataError
from kros.data import EpisodeBatch
from kros.design.baselines import make_trained
from kros.design.training import TrainingSet
from kros.lifting import Lifting
from kros.observer import Runtime
from kros.observer.baselines.difference import FilteredDifference
from kros.observer.baselines.extended_kalman import ExtendedKalman
from kros.observer.baselines.learned import Features, Moments, Ridge

DT = 0.001
KOOPMAN = Lifting(("position", "velocity", "current"), ("sin(10*position + phase)",), ("phase",))


def test_extended_filter_is_the_textbook_recursion_with_numerical_slopes():
    """Without its update where a measurement is missing."""
    rng = np.random.default_rng(0)
    A, B = 0.2 * rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    Q, R, P0 = np.diag([1e-3, 1e-2, 1e-1]), np.array([[0.02]]), np.diag([0.02, 1.0, 2.0])
    y, u, phases = rng.normal(size=(40, 2, 1)), rng.normal(size=(40, 2, 2)), np.array([0.4, -1.0])
    y[10:15, 0], y[30, 1] = np.nan, np.nan
    found = ExtendedKalman(KOOPMAN, A, B, (0,), Q, R, P0).run(y, u, {"phase": phases})
    for i, phase in enumerate(phases):

        def model(x, v, phase=phase):
            return A[:3] @ [*x, np.sin(10 * x[0] + phase)] + B[:3] @ v

        x, P, C = np.array([y[0, i, 0], 0, 0]), P0, np.eye(1, 3)
        for k in range(40):
            np.testing.assert_allclose(found[k, i], x, rtol=1e-6, atol=1e-8)
            if np.isfinite(y[k, i, 0]):
                L = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
                x, P = x + L @ (y[k, i] - C @ x), (np.eye(3) - L @ C) @ P
            F = np.array([(model(x + d, u[k, i]) - model(x - d, u[k, i])) / 2e-6 for d in 1e-6 * np.eye(3)]).T
            x, P = model(x, u[k, i]), F @ P @ F.T + Q


def test_extended_filter_of_late_measurements_is_that_of_punctual_ones_predicted_forward():
    rng, d = np.random.default_rng(1), 2
    A, B = 0.2 * rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    Q, R, P0 = np.diag([1e-3, 1e-2, 1e-1]), np.array([[0.02]]), np.diag([0.02, 1.0, 2.0])
    y, u, phase = rng.normal(size=(30, 1, 1)), rng.normal(size=(30, 1, 2)), {"phase": np.array([0.4])}
    punctual = ExtendedKalman(KOOPMAN, A, B, (0,), Q, R, P0)
    arrives = np.concatenate([np.repeat(y[:1], d, axis=0), y[:-d]])
    found = replace(punctual, runtime=Runtime(d)).run(arrives, u, phase)[:, 0]
    before = punctual.run(y, u, phase)[:, 0]
    for k in range(30):
        x = before[max(k - d, 0)]
        for j in range(max(k - d, 0), k):
            x = A[:3] @ [*x, np.sin(10 * x[0] + 0.4)] + B[:3] @ u[j, 0]
        np.testing.assert_allclose(found[k], x, rtol=1e-12, atol=1e-12)


def test_filtered_difference_of_a_ramp_and_a_sine():
    t = np.arange(4000) * DT
    y = np.stack([2.0 * t, np.sin(2 * np.pi * 40 * t)], axis=1)[..., None]
    found = FilteredDifference(3, ((0, 1),), 40.0, DT).run(y, np.zeros((4000, 2, 0)))
    assert np.isnan(found[..., [0, 2]]).all()
    assert found[-1, 0, 1] == pytest.approx(2.0)
    # At its cut-off a Butterworth filter passes 1/sqrt(2); the difference of a sine has amplitude 2 sin(w dt / 2) / dt.
    expected = 2 * np.sin(np.pi * 40 * DT) / DT / np.sqrt(2)
    assert np.sqrt(2 * np.mean(found[2000:, 1, 1] ** 2)) == pytest.approx(expected, rel=1e-6)  # over eighty periods
    later = y.copy()
    later[2000:] += 1.0
    changed = FilteredDifference(3, ((0, 1),), 40.0, DT).run(later, np.zeros((4000, 2, 0)))
    np.testing.assert_array_equal(changed[:2001, :, 1], found[:2001, :, 1])  # row k reads measurements up to k - 1
    assert changed[2001, 0, 1] != found[2001, 0, 1]


def test_learned_estimator_is_ridge_regression_on_past_samples():
    """Least squares on regressors written down one by one; an episode of another unit, and a longer one, count by their samples."""
    rng = np.random.default_rng(4)
    settings, lengths = Ridge(delays=4, penalty=1e-3), [9, 31, 20]
    states, u = rng.normal(size=(31, 3, 3)), rng.normal(size=(31, 3, 1))
    batch = batch_of(states, u, DT, None, lengths, ["a", "a", "b"])
    rows, truths = [], []
    for i, length in enumerate(lengths):
        z = np.concatenate([states[:, i, [1]], u[:, i]], axis=1)
        for k in range(length):
            past = [z[max(k - 1 - j, 0)] for j in range(4)]
            rows.append([1.0, *past[0], *(c for j in range(1, 4) for c in past[j] - past[j - 1])])
            truths.append(states[k, i, [0, 2]])
    rows, truths = np.array(rows), np.array(truths)
    moments = Moments.of([batch], (1,), settings=settings)
    found = moments.estimator().run(states[..., [1]], u)
    penalty = np.diag(np.sqrt(1e-3 * np.sum(rows**2, axis=0)) * [0, *[1] * 8])
    wanted = np.linalg.lstsq(np.vstack([rows, penalty]), np.vstack([truths, np.zeros((9, 2))]))[0]
    np.testing.assert_allclose(found[:9, 0][:, [0, 2]], (rows @ wanted)[:9], rtol=1e-9, atol=1e-11)
    assert np.isnan(found[..., 1]).all()
    changed = states.copy()
    changed[:, :2, 2] *= -3
    others = Moments.of([replace(batch, states=changed)], (1,), settings=settings)
    for one, other in zip(vars(moments.estimator(["a"])).values(), vars(others.estimator(["a"])).values(), strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(DataError, match="no unit is left"):
        moments.estimator(["a", "b"])


def test_features_are_of_past_samples_alone():
    rng = np.random.default_rng(3)
    y, u = rng.standard_normal((300, 1)), rng.standard_normal((300, 2))
    features = Features(100.0, delays=(1, 7), averages=(0.1,))
    X = features.of(y, u)
    changed = y.copy()
    changed[200:] += 1.0
    np.testing.assert_array_equal(features.of(changed, u)[:201], X[:201])
    assert not np.allclose(features.of(changed, u)[201], X[201])
    v = np.hstack([y, u])
    np.testing.assert_allclose(X[50, :3], v[49])
    np.testing.assert_allclose(X[50, 3:6], v[0])
    np.testing.assert_allclose(X[50, 10:13], v[49] - v[42])
    a = np.exp(-1 / 10)
    slow = v[0]
    for k in range(50):
        slow = a * slow + (1 - a) * v[max(0, k - 1)] if k else slow
    slow = a * slow + (1 - a) * v[49]
    np.testing.assert_allclose(X[50, 13:], slow)


@pytest.mark.parametrize("kind", ["boosting", "network"])
def test_a_unit_is_estimated_by_a_regression_that_does_not_know_it(kind):
    rng = np.random.default_rng(0)
    arrays = {}
    for unit, level in {"a": 1.0, "b": 1.0, "c": 5.0}.items():  # what a hidden state is, nothing tells but the unit
        x = rng.standard_normal((2, 150)).cumsum(axis=1)
        arrays[unit] = [np.column_stack([one, level + 0.01 * rng.standard_normal(150), one]) for one in x]
    population = kros.from_arrays(arrays, states=["x", "level"], measured=["x"], inputs=["u"], sample_period_s=0.01)
    training = TrainingSet(population, population.keys(), {unit: {} for unit in arrays})
    baseline = make_trained(training, (0,), kind)
    batch = EpisodeBatch.read(population, population.keys(unit="c"))
    known = baseline.by_unit[""].run(batch.measurements([0]), batch.inputs)
    unknown = baseline.estimate(batch.keys, batch.measurements([0]), batch.inputs, {})
    assert np.isnan(unknown[..., 0]).all()
    np.testing.assert_allclose(unknown[..., 1], 1.0, atol=0.1)
    assert known[..., 1].mean() > 1.5
