"""The file of a deployed observer says all that is needed to put it into a machine, and what it says is what the recordings hold."""

import json
from importlib.metadata import version
from typing import Any

import numpy as np
import pytest

import kros
from kros.core.artifacts import check_checksum
from kros.observer import Observer
from kros.plants import PLANTS

MAPPING: dict[str, Any] = {
    "files": r"(?P<unit>\w+)_(?P<episode>\d+)[.]csv",
    "time": "t",
    "channel": [
        {"name": "current", "column": "I (mA)", "role": "state", "unit": "A", "scale": 1e-3},
        {"name": "angle", "column": 2, "role": "state", "unit": "rad", "measured": True, "scale": np.pi / 180},
        {"name": "voltage", "column": "U", "role": "input", "unit": "V"},
    ],
    "prepare": [
        {"step": "shift", "channels": ["voltage"], "lag": 2},
        {"step": "offset", "channel": "angle", "reference": "current", "start": 0, "stop": 1},
    ],
}


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> tuple[Any, dict[str, Any]]:
    """DC motors as CSV files in degrees and mA, an input that lags; the study, and the file of what it deploys."""
    folder = tmp_path_factory.mktemp("about")
    population = PLANTS["dc-motor"](n_units=4, n_episodes=3, seconds=1.5, seed=5).simulate().population
    names = [c.name for c in population.channels]
    angle, current, voltage = (next(i for i, n in enumerate(names) if word in n) for word in ("position", "current", "voltage"))
    (folder / "rec").mkdir()
    for key in population.episodes:
        values, dt = population.read(key), population.sample_period_s
        rows = np.column_stack([dt * np.arange(len(values)), np.degrees(values[:, angle]), 1e3 * values[:, current], values[:, voltage]])
        np.savetxt(folder / "rec" / f"{key.unit}_{key.episode}.csv", rows, delimiter=",", header="t,deg,I (mA),U", comments="")
    quick: dict[str, Any] = {
        "identify": {"refine": False},
        "uncertainty": {"n_freqs": 60, "max_order": 1},
        "synthesis": {"methods": ["residual_h2"], "input_weight": 3.0},
        "observer": {"baselines": ["open_loop"], "deployed": "linear_edmd/residual_h2"},
        "sensor": {"angle": {"noise": 1e-4}},
    }
    study = kros.run(kros.read(folder / "rec", mapping=MAPPING), folder / "run", until="synthesize", **quick)
    return study, json.loads((study.folder / "observers" / "deployed.json").read_text())


def test_the_file_is_complete(found) -> None:
    study, content = found
    about = content["about"]
    assert check_checksum(content, study.folder)
    assert content["states"] == ["current", "angle"]
    assert about["units_of_measure"] == {"current": "A", "angle": "rad", "voltage": "V"}
    assert (about["kros"], about["study"]) == (version("kros"), "run")
    assert set(about) >= {"columns", "sensor", "trained_on", "as_it_runs", "recorded_signals", "uncertain_set"}
    assert about["trained_on"]["units"] == 4
    assert about["as_it_runs"]["certified"] == study.metrics["observers"][study.metrics["study"]["deployed"]]["relift_certified"]
    assert about["sensor"]["angle"]["noise"] == pytest.approx(1e-4)


def test_columns_and_ranges_are_those_of_the_recordings(found) -> None:
    """The largest values, read from the files as the object ``columns`` says, are those that it gives in the channels' units."""
    study, content = found
    about, folder = content["about"], study.folder.parent / "rec"
    assert about["columns"]["angle"] == {
        "column": 2, "factor": pytest.approx(np.pi / 180), "lag_samples": 0, "offset": "mean of current - angle over samples 0 to 0 of every episode",
    }  # fmt: skip
    assert about["columns"]["voltage"] == {"column": "U", "factor": 1.0, "lag_samples": 2, "offset": ""}
    training = [f for f in sorted(folder.iterdir()) if not f.stem.endswith("_2")]  # the last episode is held out
    voltage = max(np.abs(np.loadtxt(f, delimiter=",", skiprows=1)[2:, 3]).max() for f in training)
    assert about["largest_in_training"]["voltage"] == pytest.approx(voltage, rel=0.02)


def test_what_was_written_is_read(found, tmp_path) -> None:
    study, content = found
    observer = Observer.load(study.folder / "observers" / "deployed.json")
    assert observer.about == content["about"]
    assert observer.about["as_it_runs"]["operating_box"] in ({}, None)
    observer.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (study.folder / "observers" / "deployed.json").read_bytes()
