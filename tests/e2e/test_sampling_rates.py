"""Studies of any sampling rate run: nothing but the axis of frequency may depend on the sampling period."""

from __future__ import annotations

import json

import numpy as np
import pytest

from kros import from_arrays
from kros.data import write_parquet
from kros.study import load_config
from kros.study import run as run_study
from kros.study.config import Stage

pytestmark = pytest.mark.usefixtures("low_order_weights")
PERIODS_S = (10.0, 5e-5)
# Less of everything that takes long; none of it knows of seconds.
QUICK = ["uncertainty.n_freqs=100", "estimator.rows=2000", "estimator.episodes=16", "estimator.sample_episodes=8"]
QUICK += ["estimator.features=8"]


@pytest.fixture(scope="module")
def errors(tmp_path_factory):
    """Errors of all observers by sampling period, on the same samples."""
    rng = np.random.default_rng(4)
    units = {}
    for name in "abc":
        slow, episodes = 0.97 + 0.01 * rng.random(), []
        for _ in range(3):
            x, u = np.zeros((300, 2)), np.repeat(rng.normal(size=(30, 1)), 10, axis=0)
            for k in range(299):
                x[k + 1] = [0.8 * x[k, 0] + 0.2 * x[k, 1] + 0.1 * u[k, 0], slow * x[k, 1] + 0.05 * u[k, 0]]
            episodes.append(np.hstack([x + 1e-3 * rng.normal(size=x.shape), u]))
        units[name] = episodes
    found = {}
    for period in PERIODS_S:
        folder = tmp_path_factory.mktemp("rate")
        population = from_arrays(
            units, states=["voltage", "heat"], measured=["voltage"], inputs=["current"], sample_period_s=period
        )
        write_parquet(population, folder / "recordings")
        (folder / "study.toml").write_text('[data]\nsource = "recordings"\nreader = "parquet"\n')
        metrics = run_study(load_config(folder / "study.toml", QUICK), folder / "run", until=Stage.EVALUATE).metrics
        found[period] = {(r["observer"], r["unit"], r["channel"]): r["error_percent"] for r in metrics["evaluation"]}
    return found


def test_errors_do_not_depend_on_the_sampling_period(errors):
    slow, fast = (errors[period] for period in PERIODS_S)
    assert slow.keys() == fast.keys()
    np.testing.assert_allclose(*(np.array(list(found.values()), float) for found in (fast, slow)), rtol=1e-6)


def test_measured_cells_at_a_tenth_of_a_hertz_run(kros, recordings, tmp_path):
    roles = ("--measured", "voltage", "--input", "current")
    found = kros("init", recordings / "dmegc_cells", *roles, "--out", tmp_path / "study.toml")
    assert found.exit_code == 0, found.output
    few = ["identify.refine=false", 'synthesis.methods=["estimator"]', 'observer.baselines=["open_loop", "learned"]']
    quick = (part for setting in [*QUICK, *few] for part in ("--set", setting))
    done = kros("run", tmp_path / "study.toml", "--out", tmp_path / "run", "--until", "evaluate", *quick)
    assert done.exit_code == 0, done.output
    rows = json.loads((tmp_path / "run" / "metrics.json").read_text())["evaluation"]
    assert {row["unit"] for row in rows} == {"cell1", "cell2", "cell3", "cell4"}
