"""Tuned baselines against the textbook's, written down a second time: DC motors that turn for many revolutions under a voltage."""

import numpy as np
import pytest
from batches import batch_of
from scipy.linalg import solve_discrete_are

import kros
from kros.data import EpisodeBatch
from kros.design.methods import methods_of
from kros.design.synthesize import tasks_of
from kros.lifting import Lifting
from kros.observer import EstimatorSettings, run_observer
from kros.observer.residual import residual_covariance
from kros.observer.units import in_sizes
from kros.plants import DcMotorPopulation


@pytest.fixture(scope="module")
def uncertain():
    population = DcMotorPopulation(n_units=4, n_episodes=4, seconds=4.0, seed=11).simulate().population
    return kros.quantify(kros.identify(population, refine=False), n_freqs=50, max_order=1)


def task(uncertain, method):
    return tasks_of(uncertain, "linear_edmd", methods_of([method], EstimatorSettings()))[0]


def percent(estimate, batch):
    """RMS over the largest value, mean over episodes, of velocity and current."""
    error = np.sqrt(np.mean((estimate - batch.states) ** 2, axis=0)) / np.abs(batch.states).max(axis=0)
    return 100 * error.mean(axis=0)[1:]


def textbook(train, test, resolution):
    """A Kalman predictor for one model of all units by least squares, with the full covariance of what it misses in a step."""
    x, u = train.states, train.inputs
    regressors = np.concatenate([x, u], axis=-1)[:-1].reshape(-1, 4)
    following = x[1:].reshape(-1, 3)
    W = np.linalg.lstsq(regressors, following)[0].T
    missed = following - regressors @ W.T
    A, B, C, Q, R = W[:, :3], W[:, 3:], np.eye(1, 3), missed.T @ missed / len(missed), np.array([[resolution**2 / 12]])
    P = solve_discrete_are(A.T, C.T, Q, R)
    L = A @ P @ C.T / (C @ P @ C.T + R)
    found = np.zeros(test.states.shape)
    found[0, :, 0] = test.states[0, :, 0]
    for k in range(len(found) - 1):
        found[k + 1] = found[k] @ A.T + test.inputs[k] @ B.T + (test.states[k, :, :1] - found[k, :, :1]) @ L.T
    return percent(found, test)


def test_the_tuned_filter_is_at_least_as_good_as_the_textbooks(uncertain):
    facts, population = uncertain.models.facts, uncertain.models.population
    train, test = (EpisodeBatch.read(population, getattr(facts, part)) for part in ("train", "test"))
    known = textbook(train, test, facts.resolution["position"])
    kalman, alone = task(uncertain, "kalman_tuned"), task(uncertain, "open_loop")
    found = kalman.method.design(kalman)
    observer = in_sizes(found.observer, {})
    own = percent(run_observer(observer, test.states[..., :1], test.inputs), test)
    assert np.sqrt(np.prod(own / known)) < 1.01
    assert (
        own[0]
        < 0.2
        * percent(
            run_observer(in_sizes(alone.method.design(alone).observer, {}), test.states[..., :1], test.inputs), test
        )[0]
    )
    assert "position" in found.facts["rows_fitted_to_single_steps"]


def test_covariance_of_residuals_counts_every_sample_of_every_episode_once():
    states = np.random.default_rng(0).normal(size=(8, 3, 2)) + 1
    rows = np.concatenate([states[1:6, 0], states[1:8, 1], states[1:3, 2]])
    batch = batch_of(states, states[..., :1], 0.1, lengths=[6, 8, 3])
    found = residual_covariance(Lifting(("x", "v")), np.zeros((2, 2)), np.zeros((2, 1)), batch)
    np.testing.assert_allclose(found, sum(np.outer(r, r) for r in rows) / 14)
