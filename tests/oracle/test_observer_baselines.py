"""Baselines against what is known without them: textbook recursions, analytic filters, an estimator that is linear in the past."""

from dataclasses import replace

import numpy as np
import pytest
from batches import batch_of

from kros.core.errors import DataError
from kros.data.population import EpisodeKey
from kros.lifting import Lifting
from kros.observer import ExtendedKalman, FilteredDifference, Observer, run_observer
from kros.observer.baselines.extended_kalman import start_covariance
from kros.observer.baselines.learned import Features
from kros.observer.baselines.learned_moments import Choice, Moments
from kros.synthesis import Injection, kalman

DT = 0.001
KOOPMAN = Lifting(("position", "velocity", "current"), ("sin(10*position + phase)",), ("phase",))


def stable(rng, n):
    A = rng.normal(size=(n, n))
    return 0.9 * A / np.abs(np.linalg.eigvals(A)).max()


def test_extended_filter_is_the_textbook_recursion_with_numerical_slopes():
    rng = np.random.default_rng(0)
    A, B = 0.2 * rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    Q, R, P0 = np.diag([1e-3, 1e-2, 1e-1]), np.array([[0.02]]), np.diag([0.02, 1.0, 2.0])
    y, u, phases = rng.normal(size=(40, 2, 1)), rng.normal(size=(40, 2, 2)), np.array([0.4, -1.0])
    found = ExtendedKalman(KOOPMAN, A, B, (0,), ("a", "b"), Q, R, P0).run(y, u, {"phase": phases})
    for i, phase in enumerate(phases):

        def model(x, v, phase=phase):
            return A[:3] @ [*x, np.sin(10 * x[0] + phase)] + B[:3] @ v

        x, P, C = np.array([y[0, i, 0], 0, 0]), P0, np.eye(1, 3)
        for k in range(40):
            np.testing.assert_allclose(found[k, i], x, rtol=1e-6, atol=1e-8)
            L = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
            x, P = x + L @ (y[k, i] - C @ x), (np.eye(3) - L @ C) @ P
            F = np.array([(model(x + d, u[k, i]) - model(x - d, u[k, i])) / 2e-6 for d in 1e-6 * np.eye(3)]).T
            x, P = model(x, u[k, i]), F @ P @ F.T + Q


def test_extended_filter_of_a_linear_model_settles_at_the_riccati_gain():
    rng = np.random.default_rng(1)
    A, B = stable(rng, 2), rng.normal(size=(2, 1))
    plain, Q, R = Lifting(("a", "b")), np.diag([0.3, 0.1]), np.array([[0.5]])
    y, u = rng.normal(size=(600, 1, 1)), rng.normal(size=(600, 1, 1))
    steady = Observer("k", plain, A, B, (0,), ("u",), kalman(A, np.eye(1, 2), Q, R, DT).controller, Injection.STATE, DT)
    extended = ExtendedKalman(plain, A, B, (0,), ("u",), Q, R, start_covariance(np.array([1.0, 5.0]), R, (0,)))
    np.testing.assert_allclose(extended.run(y, u)[500:], run_observer(steady, y, u)[500:], atol=1e-9)


def test_extended_filter_of_late_measurements_is_that_of_punctual_ones_predicted_forward():
    rng, d = np.random.default_rng(1), 2
    A, B = 0.2 * rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    Q, R, P0 = np.diag([1e-3, 1e-2, 1e-1]), np.array([[0.02]]), np.diag([0.02, 1.0, 2.0])
    y, u, phase = rng.normal(size=(30, 1, 1)), rng.normal(size=(30, 1, 2)), {"phase": np.array([0.4])}
    punctual = ExtendedKalman(KOOPMAN, A, B, (0,), ("a", "b"), Q, R, P0)
    arrives = np.concatenate([np.repeat(y[:1], d, axis=0), y[:-d]])
    found = replace(punctual, delay=d).run(arrives, u, phase)[:, 0]
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


def linear_in_the_past(seed=3, units=3, n_samples=900):
    """Recordings in which the hidden states are linear in the last samples, those before the start the first, and differ from unit to unit."""
    rng = np.random.default_rng(seed)
    lifting = Lifting(("x", "v"), ("sin(3*x + phase)", "x*v"), ("phase",))
    phases = rng.normal(size=units)
    u = rng.normal(size=(n_samples, units, 1))
    y = 2 * u + 0.3 + 0.5 * rng.normal(size=u.shape)
    size = 1 + np.arange(units)[:, None]
    y1, y2, y3, u2 = (a[np.maximum(np.arange(n_samples) - lag, 0)] for a, lag in ((y, 1), (y, 2), (y, 3), (u, 2)))
    ripple = 0.5 * np.sin(3 * y1[..., 0] + phases) + np.cos(3 * y2[..., 0] + phases)
    v = size * (0.7 + y1 - 2 * y3 + 0.4 * u2) + ripple[..., None]
    return lifting, np.concatenate([y, v], axis=-1), u, {"phase": phases}


def test_learned_estimator_is_ridge_regression_from_the_first_sample_on():
    """Least squares on regressors written down one by one: two units of two and one episodes, a third measured only at run time."""
    rng = np.random.default_rng(4)
    lifting, taps, ridge, lengths = Lifting(("x", "v", "w")), 4, 1e-3, [9, 31, 20]
    states, u = rng.normal(size=(31, 3, 3)), rng.normal(size=(31, 3, 1))
    batch = batch_of(states, u, DT, None, lengths, ["a", "a", "b"])
    features = Features.of(lifting, (1,), states[..., [1]], u, taps)
    assert features.static[0, 1] == 0  # the input explains nothing of the measurement
    rows, truths, weights = [], [], []
    for i, length in enumerate(lengths):
        z = np.concatenate([states[:, i, [1]] - features.static[0, 0], u[:, i]], axis=1)
        for k in range(length):
            past = [z[max(k - 1 - j, 0)] for j in range(taps)]
            rows.append(
                [1.0, *(v[c] if j == 0 else v[c] - past[j - 1][c] for c in range(2) for j, v in enumerate(past))]
            )
            truths.append(states[k, i, [0, 2]])
            weights.append([1.0, 1.0, 2.0][i] / length / np.abs(states[:length, i][:, [0, 2]]).max(axis=0) ** 2)
    rows, truths, weights = np.array(rows), np.array(truths), np.array(weights) / 4
    batches = [batch.take([i]).head(lengths[i]) for i in range(3)]
    found = Moments.of(features, batches).estimator(choices=[Choice(taps, ridge)] * 2).run(states[..., [1]], u)
    for column, state in enumerate((0, 2)):
        half = np.sqrt(weights[:, [column]])
        penalty = np.diag(np.sqrt(ridge * np.sum((half * rows) ** 2, axis=0)) * [0, *[1] * (2 * taps)])
        wanted = np.linalg.lstsq(
            np.vstack([half * rows, penalty]), np.append(half[:, 0] * truths[:, column], np.zeros(1 + 2 * taps))
        )[0]
        np.testing.assert_allclose(found[: lengths[0], 0, state], (rows @ wanted)[: lengths[0]], rtol=1e-7, atol=1e-9)


def test_learned_estimator_chooses_what_does_best_on_units_left_out():
    lifting, states, u, phases = linear_in_the_past(units=5)
    batch = batch_of(states, u, DT, phases)
    moments = Moments.of(Features.of(lifting, (0,), states[..., :1], u, taps=12), [batch])
    (chosen,) = moments.choose()
    percent = {}
    for choice in (chosen, *(Choice(taps, ridge) for taps in (2, 5, 12) for ridge in (1e-8, 1e-3, 0.1))):
        folds = [[str(i) for i in range(fold, 5, 4)] for fold in range(4)]
        runs = {
            unit: moments.estimator(fold, [choice]).run(states[..., :1], u, phases) for fold in folds for unit in fold
        }
        errors = [runs[unit][:, int(unit), 1] - states[:, int(unit), 1] for unit in batch.units]
        percent[choice] = np.mean(
            [np.sqrt(np.mean(e**2)) / np.abs(states[:, i, 1]).max() for i, e in enumerate(errors)]
        )
    assert percent[chosen] == min(percent.values())


def test_a_condition_that_misleads_is_not_trained_on():
    lifting, states, u, phases = linear_in_the_past(units=6)
    states[:, 3:, 1] = np.random.default_rng(0).normal(size=(900, 3))  # nothing to learn there, and no unit's own size
    keys = tuple(EpisodeKey(unit, condition, "0") for condition in ("good", "noise") for unit in "abc")
    batch = replace(batch_of(states, u, DT, phases), keys=keys)
    batch.states[:, :3, 1] /= 1 + np.arange(3)
    moments = Moments.of(Features.of(lifting, (0,), states[..., :1], u, taps=5), [batch])
    assert moments.units == ("a", "b", "c")
    assert moments.choose()[0].condition == "good"


def test_a_unit_that_is_left_out_leaves_no_trace():
    lifting, states, u, phases = linear_in_the_past()
    features = Features.of(lifting, (0,), states[..., :1], u, taps=6)
    moments = Moments.of(features, [batch_of(states, u, DT, phases, [900, 900, 700], list("abc"))])
    changed = states.copy()
    changed[:, 1] *= -3
    others = Moments.of(features, [batch_of(changed, u, DT, phases, [900, 900, 700], list("abc"))])
    y = states[..., :1]
    kept, again = (m.estimator(["b"]).run(y, u, phases)[..., 1] for m in (moments, others))
    np.testing.assert_array_equal(kept, again)
    assert np.abs(moments.estimator().run(y, u, phases) - others.estimator().run(y, u, phases))[..., 1].max() > 0.1
    with pytest.raises(DataError, match="no unit is left"):
        moments.estimator(["a", "b", "c"])
