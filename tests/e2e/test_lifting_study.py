"""Studies with families, delays and input functions, from a TOML file to metrics.json, and what they refuse."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

from kros.identify import ModelSet
from kros.observer import Observer

LIFTING = """
[lifting]
functions = ["sin(100*position + phase)"]
input_functions = ["current[-1]*target_velocity"]

[[lifting.families]]
kind = "delays"
names = ["current", "target_velocity"]
depth = 2

[[lifting.families]]
kind = "radial"
names = ["velocity"]
centres = { kind = "kmeans", n = 2, seed = 1 }
length = 5.0

[identify]
refine = false

[uncertainty]
n_freqs = 60

[synthesis]
methods = []

[observer]
baselines = ["kalman_tuned"]
"""
INPUTS = ("target_position", "target_velocity")
GIVEN = ("sin(100*position + phase)", "current[-1]", "target_velocity[-1]", "current[-2]", "target_velocity[-2]")
INPUT_FUNCTIONS = ("current[-1]*target_velocity",)


@pytest.fixture(scope="module")
def run(kros, low_order_weights, tmp_path_factory):
    """A finished study of a lifting with everything in it, beside its recordings of three drives."""
    folder = tmp_path_factory.mktemp("lifting")
    assert kros("simulate", folder / "drives", "--units", 3, "--episodes", 3, "--seconds", 5).exit_code == 0
    (folder / "study.toml").write_text(f'[data]\nsource = "drives"\nreader = "parquet"\n{LIFTING}')
    result = kros("run", folder / "study.toml", "--out", folder / "run", "--until", "evaluate")
    assert result.exit_code == 0, result.output
    return folder / "run"


def test_models_carry_the_whole_lifting(run):
    models = ModelSet.load(run / "models" / "koopman_edmd")
    assert models.lifting.functions[:5] == GIVEN
    assert all(f.startswith("exp(") for f in models.lifting.functions[5:])
    assert (models.lifting.history, models.inputs) == (2, (*INPUTS, *INPUT_FUNCTIONS))
    assert (models.A.shape[1:], models.B.shape[1:]) == ((10, 10), (10, 3))
    linear = ModelSet.load(run / "models" / "linear_edmd")
    assert (linear.lifting.history, linear.inputs, linear.B.shape[1:]) == (0, INPUTS, (3, 2))


def test_observers_run_with_it(run, kros, tmp_path):
    metrics = json.loads((run / "metrics.json").read_text())
    free = metrics["models"]["koopman_edmd"]
    assert free["order"] == 10
    assert all(np.isfinite(e["worst"]) for e in free["freerun_error_percent"].values())
    assert metrics["observers"]["koopman_edmd/kalman_tuned"].get("status") != "failed"
    observer = Observer.load(run / "observers" / "koopman_edmd" / "kalman_tuned.json")
    assert (observer.inputs, observer.lifting.input_functions, observer.lifting.history) == (INPUTS, INPUT_FUNCTIONS, 2)
    result = kros("estimate", run, run.parent / "drives", tmp_path / "estimates.parquet")
    assert result.exit_code == 0, result.output
    assert len(pq.read_table(tmp_path / "estimates.parquet")) > 0
    result = kros("check", run, run.parent / "drives")
    assert result.exit_code == 4, result.output  # of three units none can be told from the others
