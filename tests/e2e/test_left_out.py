"""Units that are left out: what is made for them comes from all others alone, and their errors are those of what was made."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from kros.core.artifacts import load_artifact, read_json
from kros.core.work import Work
from kros.data import split_episodes, write_parquet
from kros.data.readers.parquet import read_parquet
from kros.identify import ModelSet
from kros.identify.calibration import calibration_keys, segments_of, unit_parameters
from kros.observer import Observer, run_observer
from kros.study import load_config
from kros.study import run as run_study
from kros.study.config import Stage
from kros.study.engine.context import Context
from kros.study.engine.store import Store
from kros.study.stages.left_out import without

pytestmark = pytest.mark.usefixtures("low_order_weights")
UNITS = ("001", "002", "003", "004")
FAST = (
    '[data]\nsource = "{source}"\nreader = "parquet"\n'
    "[identify]\nrefine = false\n"
    "[uncertainty]\nn_freqs = 60\n"
    '[synthesis]\nmethods = ["residual_h2"]\n'
    '[observer]\nbaselines = ["open_loop", "filtered_difference", "learned"]\n'
    "[evaluate]\nfolds = {folds}\n"
)


def study(folder, source, folds=0):
    """Write a quick study of pendulums."""
    path = folder / "study.toml"
    path.write_text(FAST.format(source=source, folds=folds))
    return path


@pytest.fixture(scope="module")
def run(pendulums, tmp_path_factory):
    """A study that leaves out the first and third, then the second and fourth."""
    folder = tmp_path_factory.mktemp("left_out")
    result = run_study(load_config(study(folder, pendulums, folds=2)), folder / "run", until=Stage.LEFT_OUT)
    return folder / "run", result.metrics["left_out"]


def test_a_fold_is_the_study_on_recordings_that_do_not_hold_its_units(pendulums, run, tmp_path):
    write_parquet(read_parquet(pendulums).select(["002", "004"]), tmp_path / "others")
    alone = tmp_path / "run"
    run_study(load_config(study(tmp_path, tmp_path / "others")), alone, until=Stage.SYNTHESIZE)
    fold = run[0] / "left_out" / "0"
    for name in ("koopman_edmd", "linear_edmd"):
        if (alone / "models" / name).exists():
            one, other = ModelSet.load(fold / "models" / name), ModelSet.load(alone / "models" / name)
            assert one.unit_ids == other.unit_ids == ("002", "004")
            assert np.array_equal(one.A, other.A)
            assert np.array_equal(one.B, other.B)
            weights = [load_artifact(place / "uncertainty" / name, "uncertain_model")[1] for place in (fold, alone)]
            assert all(np.array_equal(weights[0][key], weights[1][key]) for key in weights[0])
    made = sorted(p.relative_to(fold / "observers") for p in (fold / "observers").glob("*/*.json"))
    assert made == sorted(p.relative_to(alone / "observers") for p in (alone / "observers").glob("*/*.json"))
    assert made
    for name in [*made, "observers.json"]:
        assert (fold / "observers" / name).read_text() == (alone / "observers" / name).read_text()


def test_every_unit_is_judged_once_by_what_its_fold_made(pendulums, run):
    folder, left_out = run
    assert left_out["folds"] == [["001", "003"], ["002", "004"]]
    rows = [r for r in left_out["rows"] if r["channel"] == "velocity"]
    observers = set(left_out["observers"])
    assert {"linear_edmd/residual_h2", "filtered_difference", "learned"} <= observers
    assert sorted((r["observer"], r["unit"]) for r in rows) == sorted((o, u) for o in observers for u in UNITS)
    population = read_parquet(pendulums)
    key = split_episodes(population)["003", population.conditions[0]].test[0]
    states, inputs = population.read_parts(key)
    observer = Observer.load(folder / "left_out" / "0" / "observers" / "linear_edmd" / "residual_h2.json")
    error = run_observer(observer, states[:, None, list(observer.measured)], inputs[:, None])[:, 0] - states
    found = next(r for r in rows if (r["observer"], r["unit"]) == ("linear_edmd/residual_h2", "003"))
    assert found["fold"] == 0
    assert found["rms"] == pytest.approx(np.sqrt(np.mean(error[:, 1] ** 2)))
    assert left_out["observers"]["linear_edmd/open_loop"]["made"] == 2
    assert left_out["observers"]["linear_edmd/open_loop"]["relift_certified"] in (0, 1, 2)
    assert left_out["observers"]["learned"]["relift_certified"] is None


def test_nothing_is_made_twice_and_what_is_not_asked_for_is_gone(kros, run):
    folder = run[0]
    again = kros("run", folder.parent / "study.toml", "--out", folder, "--until", "left_out")
    assert again.exit_code == 0
    stages = [line for line in again.stderr.splitlines() if line[:1].islower() or line[:1].isdigit()]
    assert all(line.endswith("unchanged") for line in stages)
    made = json.loads((folder / "left_out" / "1" / "manifest.json").read_text())
    shutil.copytree(folder, folder.parent / "copy")
    options = ("--until", "left_out", "--set", "evaluate.folds=0", "--json")
    off = kros("run", folder.parent / "study.toml", "--out", folder.parent / "copy", *options)
    assert "left_out" not in json.loads(off.stdout)
    assert not (folder.parent / "copy" / "left_out" / "left_out.json").exists()
    assert read_json(folder / "left_out" / "1" / "manifest.json") == made


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (["evaluate.folds=1"], "at least 2"),
        (["evaluate.folds=-2"], "greater than or equal to 0"),
        (["evaluate.folds=5"], "of 4 units each fold needs one"),
        (["evaluate.folds=2", 'data.exclude=["004"]'], "of 3 units each fold needs one"),
        (['data.exclude=["004", "xyz"]'], "no unit xyz"),
        (['data.exclude=["001", "002", "003"]'], "at least two units"),
    ],
)
def test_folds_that_cannot_be_made_are_refused_at_once(kros, pendulums, tmp_path, settings, told):
    options = [part for setting in settings for part in ("--set", setting)]
    result = kros("run", study(tmp_path, pendulums), "--out", tmp_path / "run", *options)
    assert result.exit_code == 2
    assert told in result.stderr
    assert not (tmp_path / "run").exists()


def test_a_unit_that_is_left_out_is_calibrated_as_a_new_one(kros, tmp_path):
    """Its phase comes from its own training episodes; what the fold knows of it is the branch."""
    assert kros("simulate", tmp_path / "drives", "--units", 3, "--episodes", 2, "--seconds", 8).exit_code == 0
    config = load_config(study(tmp_path, tmp_path / "drives"), ['data.exclude=["001003"]'])
    fold, whole = tmp_path / "fold", tmp_path / "whole"
    run_study(config, fold, until=Stage.CALIBRATE)
    run_study(load_config(study(tmp_path, tmp_path / "drives")), whole, until=Stage.CALIBRATE)
    contexts = [Context(config, Store(folder), Work()) for folder in (whole, fold)]
    unit, calibration = contexts[0].population.select(["001003"]), contexts[1].calibration
    prefer = contexts[1].facts.identify_on
    phases = unit_parameters(unit, calibration, prefer, contexts[0].facts)
    assert phases == unit_parameters(unit, calibration, prefer)
    segments = segments_of((unit, calibration_keys(contexts[0].facts, "001003"), calibration.spec))
    assert phases == {"001003": {"phase": calibration.calibrate(segments, "001003").phase_rad}}
    assert "001003" not in calibration.units
    made = without(contexts[1], ["001002"])
    assert made.data.exclude == ("001003", "001002")
    assert made.data.source == tmp_path / "drives"


def test_units_in_reserve_take_part_in_nothing_and_bound_the_next(pendulums, run, tmp_path):
    """With two in reserve the study is that on the other two alone, to the last digit; it meets them with its deployed observer."""
    folder = tmp_path / "run"
    settings = ["evaluate.reserve=2", "evaluate.confidence=0.6"]
    made = run_study(load_config(study(tmp_path, pendulums), settings), folder, until=Stage.LEFT_OUT)
    found, condition = made.metrics["next_unit"], made.metrics["study"]["identify_on"]
    reserve, others = found["units"], [row["unit"] for row in made.metrics["units"]]
    assert sorted([*reserve, *others]) == list(UNITS)
    assert len(reserve) == found["reserve"] == made.metrics["study"]["units"] == 2
    excluded = "data.exclude=" + json.dumps(reserve)
    run_study(load_config(study(tmp_path, pendulums), [excluded]), tmp_path / "alone", until=Stage.EVALUATE)
    for part in ("models", "uncertainty", "observers", "evaluation"):
        files = [p.relative_to(folder) for p in (folder / part).rglob("*.json")]
        files = [p for p in files if p.name != "relift.json"]  # that one holds seconds
        assert files
        assert all((folder / p).read_bytes() == (tmp_path / "alone" / p).read_bytes() for p in files)

    population = read_parquet(pendulums)
    observer = Observer.load(folder / "observers" / "deployed.json")
    velocity = population.states.index("velocity")
    errors = {}
    for unit in reserve:
        (key,) = split_episodes(population)[unit, condition].test
        states, inputs = population.read_parts(key)
        estimate = run_observer(observer, states[:, None, list(observer.measured)], inputs[:, None])[:, 0]
        errors[unit] = np.sqrt(np.mean((estimate - states)[:, velocity] ** 2))
    rows = {r["unit"]: r for r in found["rows"] if r["channel"] == "velocity"}
    assert {u: r["rms"] for u, r in rows.items()} == pytest.approx(errors)
    bound = found["bounds"]["velocity"]
    assert found["reason"] is None
    # the second of two: one measure decides
    assert [m for m in bound if bound[m] == pytest.approx(max(r[m] for r in rows.values()))]
    assert all(bound[m] >= 0.999999 * r[m] for m in bound for r in rows.values())


def test_too_small_a_reserve_says_what_is_needed(kros, pendulums, tmp_path):
    path = study(tmp_path, pendulums)
    config = load_config(path, ["evaluate.reserve=1"])
    found = run_study(config, tmp_path / "run", until=Stage.LEFT_OUT).metrics
    assert found["next_unit"]["bounds"] is None
    assert found["next_unit"]["reason"] == "1 units in reserve, and a confidence of 0.95 needs 19"
    assert "left_out" not in found
    fold = without(Context(config, Store(tmp_path / "run"), Work()), ["003"])
    assert fold.data.exclude == (*found["next_unit"]["units"], "003")
    assert fold.evaluate.reserve == 0
    refused = kros("run", path, "--out", tmp_path / "none", "--set", "evaluate.reserve=3")
    assert refused.exit_code == 2
    assert "evaluate.reserve = 3: there are 4 units" in refused.stderr
    assert not (tmp_path / "none").exists()
