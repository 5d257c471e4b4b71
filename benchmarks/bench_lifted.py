"""Large liftings and long batches: memory of fitting in chunks, and free runs beside pykoop in the same run.

pytest benchmarks/bench_lifted.py --benchmark-only
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import tracemalloc

import numpy as np
import pytest

from kros.identify import Factor, KoopmanMatrices, combine, edmd, free_run, lifted_factor, reduce_episode
from kros.lifting import Lifting

EPISODES, SAMPLES, COLUMNS = 38, 20_000, 95
STATES = ("a", "b", "c")
CHUNK_MB = SAMPLES * (len(STATES) + 2) * 8 / 1e6  # one episode as recorded
LIMIT_MB = 200


def wide_lifting() -> Lifting:
    """Three states with as many sines and cosines as make 95 lifted states."""
    functions = [f"{f}({k + 1}*{s})" for k in range(16) for s in STATES for f in ("sin", "cos")]
    return Lifting(STATES, tuple(functions[: COLUMNS - len(STATES)]))


def episode(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(SAMPLES, 3)).cumsum(axis=0) * 1e-2, rng.normal(size=(SAMPLES, 2))


def fit_by_chunks() -> KoopmanMatrices:
    """Reduce one episode at a time and carry nothing but one triangular factor."""
    lifting = wide_lifting()
    kept: Factor | None = None
    for seed in range(EPISODES):
        one = reduce_episode(*episode(seed), lifting)
        kept = one if kept is None else combine(Factor(*(np.stack(pair) for pair in zip(parts(kept), parts(one), strict=True))))
    unit = Factor(*(np.asarray(part)[None] for part in parts(kept)))
    return edmd(lifted_factor(unit, lifting, {}, lifting).R[0], lifting.n_lifted, 1.0)


def parts(factor: Factor) -> tuple:
    return factor.R, factor.peak, factor.n_samples


def measure_memory() -> dict[str, float]:
    """Peak of a fresh process, beyond what it holds before the first episode, by the operating system and by the allocator."""
    import resource

    lifting = wide_lifting()
    short = np.random.default_rng(0).normal(size=(300, 5))
    reduce_episode(short[:, :3], short[:, 3:], lifting)  # formulas compiled, libraries loaded
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    begin = time.perf_counter()
    model = fit_by_chunks()
    seconds = time.perf_counter() - begin
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    tracemalloc.start()
    reduce_episode(*episode(0), lifting)
    traced = tracemalloc.get_traced_memory()[1] / 1e6
    assert np.isfinite(model.A).all()
    return {"rss_mb": after - before, "traced_one_episode_mb": traced, "seconds": seconds}


def test_fit_760_000_samples_of_95_columns_by_chunks(benchmark):
    """A chunk is one episode; what counts is the memory beyond the chunk as recorded."""
    run = benchmark.pedantic(
        subprocess.run, args=([sys.executable, __file__],), kwargs={"check": True, "capture_output": True, "text": True}, rounds=1
    )
    found = json.loads(run.stdout)
    benchmark.extra_info.update({**found, "chunk_mb": CHUNK_MB, "beyond_chunk_mb": found["rss_mb"] - CHUNK_MB, "limit_mb": LIMIT_MB})
    assert found["rss_mb"] - CHUNK_MB < LIMIT_MB


def test_free_run_of_195_episodes_against_pykoop(benchmark):
    """39 units with 5 episodes each of 2000 steps in one batch; pykoop predicts 500 steps of one episode with the same model.

    Times are per step of one episode. The polynomial model is the largest that both express: states and their squares and products.
    """
    pykoop = pytest.importorskip("pykoop")
    rng = np.random.default_rng(1)
    x, u = 0.1 * rng.normal(size=(500, 3)).cumsum(axis=0), rng.normal(size=(500, 2))
    pipeline = pykoop.KoopmanPipeline(
        lifting_functions=[("poly", pykoop.SplitPipeline([("p", pykoop.PolynomialLiftingFn(order=2))], None))],
        regressor=pykoop.Edmd(alpha=1e5),
    )
    pipeline.fit(np.hstack([x, u]), n_inputs=2, episode_feature=False)
    U = pipeline.regressor_.coef_.T
    lifting = Lifting(STATES, ("a**2", "a*b", "a*c", "b**2", "b*c", "c**2"))
    begin = time.perf_counter()
    theirs = pipeline.predict_trajectory(x[:1], u, episode_feature=False)
    pykoop_s = (time.perf_counter() - begin) / 500
    np.testing.assert_allclose(free_run(U[:, :9], U[:, 9:], lifting, {}, x[:1], u[None])[0], theirs, rtol=1e-6, atol=1e-9)
    batch, steps = 39 * 5, 2_000
    A, B = (np.repeat(np.tile(M, (39, 1, 1)), 5, axis=0) for M in (U[:, :9], U[:, 9:]))
    inputs = rng.normal(size=(batch, steps, 2))
    states = benchmark(free_run, A, B, lifting, {}, 0.1 * rng.normal(size=(batch, 3)), inputs)
    assert np.isfinite(states).all()
    if benchmark.stats is not None:
        ours_s = benchmark.stats.stats.median / (batch * steps)
        benchmark.extra_info.update({"kros_s_per_step": ours_s, "pykoop_s_per_step": pykoop_s, "ratio": pykoop_s / ours_s})


if __name__ == "__main__":
    print(json.dumps(measure_memory()))
