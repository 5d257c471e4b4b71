"""Regressions of scikit-learn as baselines: what they see, and that a unit is estimated by one that does not know it."""

import numpy as np
import pytest

import kros
from kros.data import EpisodeBatch
from kros.design.baselines import make_trained
from kros.design.training import TrainingSet
from kros.observer.baselines.learned import Features


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
