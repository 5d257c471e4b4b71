"""Identification and free runs, beside pykoop in the same run."""

import numpy as np
import pytest

from kros.identify import edmd, free_run, reduce_episode, smallest_stabilising_alpha
from kros.lifting import Lifting

LIFTING = Lifting(("position", "velocity", "current"), ("sin(100*position + phase)",), ("phase",))


def recording(n_samples, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n_samples, 3)).cumsum(axis=0) * 1e-2, rng.normal(size=(n_samples, 2))


def test_reduce_one_episode_of_20_s(benchmark):
    x, u = recording(20_000)
    assert benchmark(reduce_episode, x, u, LIFTING).R.shape == (12, 12)


def test_search_alpha_for_38_units(benchmark):
    R = np.stack([reduce_episode(*recording(2_000, seed), LIFTING).R for seed in range(38)])
    assert benchmark(smallest_stabilising_alpha, [(R, 5)]) >= 0


def test_free_run_of_76_episodes_batched(benchmark):
    """Divide by 76 x 2000 for the time of one step of one unit."""
    rng = np.random.default_rng(1)
    A, B = 0.1 * rng.normal(size=(76, 4, 4)), rng.normal(size=(76, 4, 2))
    u = rng.normal(size=(76, 2_000, 2))
    states = benchmark(free_run, A, B, LIFTING, {"phase": np.zeros(76)}, np.zeros((76, 3)), u)
    assert np.isfinite(states).all()


def test_free_run_of_one_episode_by_pykoop(benchmark):
    """Divide by 2000 for the time of one step."""
    pykoop = pytest.importorskip("pykoop")
    x, u = recording(2_000, 2)
    pipeline = pykoop.KoopmanPipeline(lifting_functions=[("poly", pykoop.PolynomialLiftingFn(order=2))], regressor=pykoop.Edmd(alpha=1e3))
    pipeline.fit(np.hstack([x, u]), n_inputs=2, episode_feature=False)
    predicted = benchmark.pedantic(pipeline.predict_trajectory, args=(x[:1], u), kwargs={"episode_feature": False}, rounds=1)
    assert predicted.shape == (2_000, 3)


def test_edmd_of_38_units_from_factors(benchmark):
    R = np.stack([reduce_episode(*recording(2_000, seed), LIFTING).R for seed in range(38)])
    assert benchmark(edmd, R, 5, 90.0).A.shape == (38, 5, 5)
