"""The file of a deployed observer says all that is needed to put it into a machine, and what it says is what the recordings hold."""

import csv
import json
import tomllib
import xml.etree.ElementTree as ET
import zipfile
from dataclasses import asdict, replace
from importlib.metadata import version
from typing import Any

import numpy as np
import pytest

import kros
from kros.core.artifacts import check_checksum
from kros.core.errors import DataError
from kros.data.steps import Scale
from kros.export import CompiledObserver
from kros.lifting import Lifting
from kros.loops.compiler import find_compiler
from kros.observer import Observer
from kros.observer.units import recorded_channel
from kros.plants import PLANTS
from kros.study.commands.estimate import estimate_recordings
from kros.study.commands.export import export_run

FIELD = """
[data]
source = "rec"
reader = "csv"
prepare = [
    {step = "shift", channels = ["voltage"], lag = 2},
    {step = "offset", channel = "angle", reference = "current", start = 0, stop = 1},
]

[data.csv]
files = '(?P<unit>\\w+)_(?P<episode>\\d+)[.]csv'
time = "t"
channel = [
    {name = "current", column = "I (mA)", role = "state", unit = "A", scale = 1e-3},
    {name = "angle", column = 2, role = "state", unit = "rad", measured = true, scale = 0.017453292519943295},
    {name = "voltage", column = "U", role = "input", unit = "V"},
]
"""
DATA: dict[str, Any] = tomllib.loads(FIELD)["data"]


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> tuple[Any, dict[str, Any]]:
    """DC motors as CSV files in degrees and mA, an input that lags; the study, and the file of what it deploys."""
    folder = tmp_path_factory.mktemp("about")
    population = PLANTS["dc-motor"](n_units=4, n_episodes=3, seconds=1.5, seed=5).simulate().population
    names = [c.name for c in population.channels]
    angle, current, voltage = (
        next(i for i, n in enumerate(names) if word in n) for word in ("position", "current", "voltage")
    )
    (folder / "rec").mkdir()
    for key in population.episodes:
        values, dt = population.read(key), population.sample_period_s
        rows = np.column_stack(
            [dt * np.arange(len(values)), np.degrees(values[:, angle]), 1e3 * values[:, current], values[:, voltage]]
        )
        np.savetxt(
            folder / "rec" / f"{key.unit}_{key.episode}.csv", rows, delimiter=",", header="t,deg,I (mA),U", comments=""
        )
    quick: dict[str, Any] = {
        "identify": {"refine": False},
        "uncertainty": {"n_freqs": 60},
        "synthesis": {"methods": ["residual_h2"]},
        "observer": {"baselines": []},
        "sensor": {"angle": {"noise": 1e-4}},
    }
    study = kros.run(
        kros.read(folder / "rec", mapping=DATA["csv"], prepare=DATA["prepare"]),
        folder / "run",
        until="synthesize",
        **quick,
    )
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
    assert (
        about["as_it_runs"]["certified"]
        == study.metrics["observers"][study.metrics["study"]["deployed"]]["relift_certified"]
    )
    assert about["sensor"]["angle"]["noise"] == pytest.approx(1e-4)


def test_columns_and_ranges_are_those_of_the_recordings(found) -> None:
    """The largest values, read from the files as the object ``columns`` says, are those that it gives in the channels' units."""
    study, content = found
    about, folder = content["about"], study.folder.parent / "rec"
    assert about["columns"]["angle"] == {
        "column": 2, "factor": pytest.approx(np.pi / 180), "lag_samples": 0, "offset": "mean of current - angle over samples 0 to 0 of every episode",
        "converted": 1.0,
    }  # fmt: skip
    assert about["columns"]["voltage"] == {
        "column": "U",
        "factor": 1.0,
        "lag_samples": 2,
        "offset": "",
        "converted": 1.0,
    }
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


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler is on the PATH")
def test_generated_code_and_estimates_are_in_the_units_of_the_recordings(found, tmp_path) -> None:
    """Degrees and mA go in and come out, of generated C and of `kros estimate`; header, README, manifest and FMU agree."""
    study, folder = found[0], found[0].folder.parent / "rec"
    (folder.parent / "field.toml").write_text(FIELD)
    estimate_recordings(study.folder, folder.parent / "field.toml", tmp_path / "estimates.csv")
    with (tmp_path / "estimates.csv").open() as file:
        rows = list(csv.DictReader(file))
    unit, episode = rows[0]["unit"], rows[0]["episode"]
    rows = [row for row in rows if (row["unit"], row["episode"]) == (unit, episode)]
    facts = json.loads((tmp_path / "estimates.csv-metadata.json").read_text())
    units = {name: recorded_channel(study.observer, name).unit for name in ("current", "angle", "voltage")}
    ended = {f"{name}_{ending}": units[name] for ending in ("hat", "band") for name in ("current", "angle")}
    assert facts["columns"] == units | ended
    names = [f"{name}_hat [{units[name]}]" for name in ("current", "angle")]
    wanted = np.array([[float(row[name]) for name in names] for row in rows])
    columns = np.loadtxt(folder / f"{unit}_{episode}.csv", delimiter=",", skiprows=1)
    angle = columns[:-2, 1] + np.degrees(1e-3 * columns[0, 2]) - columns[0, 1]  # what the README says of the offset
    voltage = columns[2:, 3]  # and of the lag
    source, _ = export_run(study.folder, tmp_path / "c", "motor")
    compiled = CompiledObserver.build(source)
    assert compiled.selftest() == 0
    estimates = compiled.run(angle[:, None], voltage[:, None])[0]
    size = np.abs(wanted).max(axis=0)
    np.testing.assert_allclose(estimates[:-1] / size, wanted[1:] / size, atol=1e-9)
    assert np.abs(wanted[:, 1] - angle).max() < 0.1 * size[1]
    assert "current [mA], angle [deg], voltage [V]" in (source / "motor.h").read_text()
    assert "| angle | deg | added: mean of current - angle" in (source / "README.md").read_text()
    manifest = json.loads((source / "manifest.json").read_text())
    assert manifest["units_of_measure"] == {"current": "mA", "angle": "deg", "voltage": "V"}
    with zipfile.ZipFile(export_run(study.folder, tmp_path / "motor.fmu", "motor", fmi=3)[0]) as archive:
        model = ET.fromstring(archive.read("modelDescription.xml"))
    units = {v.get("name"): v.get("unit") for v in model.find("ModelVariables") or ()}
    assert {name: unit for name, unit in units.items() if name != "time"} == {
        "angle": "deg",
        "voltage": "V",
        "current_hat": "mA",
        "angle_hat": "deg",
        "status": None,
    }


def test_converted_recordings_are_recordings(tmp_path) -> None:
    """A study of Parquet files that were converted from degrees is in radians, and so is what it exports."""
    arrays = {"a": [np.degrees(np.linspace(0, 1, 20)[:, None])]}
    population = kros.from_arrays(arrays, states=["angle"], measured=["angle"], sample_period_s=0.01)
    turned = kros.data.prepare(population, [Scale(("angle",), np.pi / 180, unit="rad")])
    kros.data.write_parquet(turned, tmp_path / "rec")
    doubled = kros.data.prepare(kros.read(tmp_path / "rec"), [Scale(("angle",), 2.0)])
    for population, factor, unit in (
        (turned, np.pi / 180, "deg"),
        (kros.read(tmp_path / "rec"), 1.0, "rad"),
        (doubled, 2.0, "2 rad"),
    ):
        about = {"columns": {"angle": asdict(population.scaling["angle"])}, "units_of_measure": {"angle": "rad"}}
        observer = replace(
            Observer.open_loop("lag", Lifting(("angle",)), np.eye(1) / 2, np.ones((1, 0)), (0,), (), 0.01), about=about
        )
        channel = recorded_channel(observer, "angle")
        assert (channel.factor, channel.unit) == (pytest.approx(factor), unit)


@pytest.mark.parametrize("factor", [0, "x", None, True, float("nan"), 10**400])
def test_a_factor_that_is_none_is_refused(factor) -> None:
    observer = Observer.open_loop("lag", Lifting(("x",)), np.eye(1) / 2, np.ones((1, 0)), (0,), (), 0.01)
    with pytest.raises(DataError, match="factor of 'x'"):
        recorded_channel(replace(observer, about={"columns": {"x": {"factor": factor}}}), "x")
