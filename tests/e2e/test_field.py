"""`kros estimate` and `kros check` as a field engineer calls them: a folder of CSV or Parquet with measured channels and inputs, and nothing else."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from csvs import write_csvs

from kros.data import Channel, Population, Role, from_arrays, write_parquet
from kros.plants import HarmonicDrivePopulation
from kros.report.manifest import describe, read_manifest, write_manifest

SEEN = ("position", "target_position", "target_velocity")
TOML = """
[data]
source = "{source}"
reader = "csv"
[data.csv]
files = '(?P<unit>[a-z0-9]+)_(?P<condition>[a-z]+)_(?P<episode>[0-9]+)[.]csv'
time = "t"
channel = [
  {{ name = "position", role = "state", measured = true, unit = "{unit}", column = "position" }},
  {{ name = "target_position", role = "input", column = "target_position" }},
  {{ name = "target_velocity", role = "input", column = "target_velocity" }},
]
"""


@pytest.fixture(scope="module")
def machines() -> Population:
    """Two drives that the study never saw, and a badly assembled one."""
    settings: dict[str, Any] = {"n_units": 2, "n_episodes": 2, "seconds": 5.0, "seed": 79, "outlier": True}
    return HarmonicDrivePopulation(**settings, conditions=("noload",)).simulate().population


@pytest.fixture
def field(machines: Population, tmp_path: Path) -> Callable[..., Path]:
    """Write what a logger in the field records, perhaps changed; returns DATA."""

    def write(change: Callable[[np.ndarray], np.ndarray] = np.asarray, unit: str = "rad") -> Path:
        columns, name = [0, 3, 4], "m{key.unit}_{key.condition}_{key.episode}.csv"
        header = ",".join(["t", *SEEN])
        write_csvs(tmp_path / "logged", machines, name, header, lambda values, _: change(values[:, columns]))
        (tmp_path / "field.toml").write_text(TOML.format(source="logged", unit=unit))
        return tmp_path / "field.toml"

    return write


@pytest.fixture(scope="module")
def lifted(demo: Path, tmp_path_factory) -> Path:
    """The demo's run as if its observer with parameters had been chosen."""
    run = tmp_path_factory.mktemp("lifted") / "run"
    shutil.copytree(demo, run)
    deployed, manifest = run / "observers" / "deployed.json", read_manifest(run)
    deployed.unlink()
    shutil.copyfile(run / "observers" / "koopman" / "estimator.json", deployed)
    manifest["synthesize"].files["observers/deployed.json"] = describe(deployed)
    write_manifest(run, manifest)
    return run


def one_direction(values: np.ndarray) -> np.ndarray:
    """The longest stretch without motion in reverse: the phase cannot be calibrated there."""
    forward = np.concatenate([[False], values[:, 2] >= -1e-9, [False]])
    edges = np.flatnonzero(np.diff(forward.astype(int)))
    start, stop = max(zip(edges[::2], edges[1::2], strict=True), key=lambda e: e[1] - e[0])
    return values[start : min(stop, start + 1000)]


def with_holes(values: np.ndarray) -> np.ndarray:
    values = values.copy()
    values[1500:1510, 0] = np.nan
    values[2500, 1] = np.inf
    return values


def table(path: Path) -> tuple[list[str], np.ndarray]:
    """The names of all columns, and the estimates and what is followed."""
    with path.open() as file:
        names, *rows = csv.reader(file)
    wanted = [i for i, name in enumerate(names) if "_hat" in name or name.startswith("phase")]
    return names, np.array([[row[i] for i in wanted] for row in rows], dtype=float)


def test_csv_and_parquet_say_the_same_with_units_and_sources(kros, demo, field, tmp_path, machines) -> None:
    data, columns = field(), ["position_hat", "velocity_hat", "current_hat"]
    for out in ("x.csv", "x.parquet"):
        result = kros("estimate", demo, data, tmp_path / out)
        assert result.exit_code == 0, result.output
        assert result.output.count("parameters calibrated on the derivative of position") == 3
    assert pq.ParquetFile(tmp_path / "x.parquet").num_row_groups == len(machines.episodes)
    assert kros("estimate", demo, data, tmp_path / "x.csv").exit_code == 2  # it is there
    names, values = table(tmp_path / "x.csv")
    found = pq.read_table(tmp_path / "x.parquet")
    states = {"position": "rad", "velocity": "rad/s", "current": "1"}
    units = {"position": "rad", "target_position": "rad", "target_velocity": "rad/s"}
    units |= {f"{state}_{ending}": unit for ending in ("hat", "band") for state, unit in states.items()}
    first = ["unit", "condition", "episode", "k", "time_s", "status"]
    assert found.column_names == [*first, *units]
    assert names == [*first, *(f"{name} [{unit}]" for name, unit in units.items())]
    np.testing.assert_array_equal(values, np.column_stack([found[c].to_numpy() for c in columns]))
    facts = json.loads((tmp_path / "x.csv-metadata.json").read_text())
    assert facts["columns"] == units
    assert {c: found.schema.field(c).metadata[b"unit"].decode() for c in units} == facts["columns"]
    recorded = np.concatenate([machines.read(key)[:, [0, 3, 4]] for key in machines.episodes])
    np.testing.assert_allclose(np.column_stack([found[c].to_numpy() for c in SEEN]), recorded, rtol=1e-12)
    np.testing.assert_allclose(found["time_s"].to_numpy(), 1e-3 * found["k"].to_numpy(), rtol=1e-12)
    seen = set(zip(found["unit"].to_pylist(), found["status"].to_pylist(), strict=True))
    bad, *good = (f"m{unit}" for unit in machines.unit_ids)
    assert seen == {(bad, "GOOD"), (bad, "UNCERTIFIED"), *((unit, "GOOD") for unit in good)}
    stated = json.loads((demo / "metrics.json").read_text())
    bound = stated["observers"][stated["study"]["deployed"]]["set_bound"]
    assert found["velocity_band"].to_pylist()[0] == pytest.approx(bound["velocity"], rel=1e-9)
    assert json.loads(found.schema.metadata[b"parameters"]) == facts["parameters"]
    assert {p["source"] for p in facts["parameters"].values()} == {"calibrated on the derivative of position"}
    whole = machines.read(machines.episodes[2])[:, :3]  # the first good drive's first episode
    at = sum(len(machines.read(key)) for key in machines.episodes[:2])
    error = np.sqrt(np.mean((values[at : at + len(whole)] - whole) ** 2, axis=0)) / np.abs(whole).max(axis=0)
    assert error[1] < 1e-3
    assert error[2] < 0.15
    # The same from kros's own format, without hidden channels.
    own = {k.unit: [machines.read(e)[:, [0, 3, 4]] for e in machines.keys(k.unit)] for k in machines.episodes}
    channels = (Channel("position", Role.STATE, "rad", True), *(Channel(n, Role.INPUT) for n in SEEN[1:]))
    write_parquet(from_arrays(own, channels, 1e-3), tmp_path / "native")
    assert kros("estimate", demo, tmp_path / "native", tmp_path / "n.csv").exit_code == 0
    np.testing.assert_allclose(table(tmp_path / "n.csv")[1], values, rtol=1e-6, atol=1e-9)


def test_a_phase_that_cannot_be_calibrated_is_followed_from_where_the_innovation_is_smallest(
    kros, lifted, field, tmp_path
) -> None:
    result = kros("estimate", lifted, field(), tmp_path / "whole.csv")
    calibrated = json.loads((tmp_path / "whole.csv-metadata.json").read_text())["parameters"]
    field(one_direction)
    result = kros("estimate", lifted, tmp_path / "field.toml", tmp_path / "x.csv")
    assert result.exit_code == 1
    assert "--track phase" in result.stderr
    options = ("--track", "phase", "--parameter", "m000000.phase=1.2")
    result = kros("estimate", lifted, tmp_path / "field.toml", tmp_path / "x.csv", *options)
    assert result.exit_code == 0, result.output
    assert result.output.count("that is given") == 1
    assert result.output.count("parameters tracked from the value of the smallest innovation") == 2
    names, values = table(tmp_path / "x.csv")
    assert names[-1] == "phase [rad]"
    facts = json.loads((tmp_path / "x.csv-metadata.json").read_text())
    assert facts["columns"]["phase"] == "rad"
    for unit in ("m001001", "m001002"):
        apart = np.angle(np.exp(1j * (facts["parameters"][unit]["phase"] - calibrated[unit]["phase"])))
        assert abs(apart) < 0.6  # motion in one direction cannot tell a phase from a lag
    assert np.isfinite(values).all()


def test_missing_samples_are_taken_and_counted(kros, demo, field, tmp_path) -> None:
    result = kros("estimate", demo, field(with_holes), tmp_path / "x.parquet")
    assert result.exit_code == 0, result.output
    assert result.output.count("20 samples MISSING; 2 samples INVALID_INPUT") == 3  # of two episodes each
    found = pq.read_table(tmp_path / "x.parquet")
    assert all(np.isfinite(found[c].to_numpy()).all() for c in ("velocity_hat", "current_hat"))
    good = np.array(found["status"].to_pylist()) == "GOOD"
    assert {"MISSING", "INVALID_INPUT"} <= set(found["status"].to_pylist())
    name = json.loads((demo / "observers/deployed.json").read_text())["name"]
    settle = json.loads((demo / "metrics.json").read_text())["observers"][name].get("settle_samples", 0)
    k, episode = found["k"].to_numpy(), np.cumsum(found["k"].to_numpy() == 0)
    settled = [good[(episode == e) & (k <= i) & (k >= i - settle)].all() for e, i in zip(episode, k, strict=True)]
    np.testing.assert_array_equal(np.isfinite(found["velocity_band"].to_numpy()), settled)  # no bound after a loss


def test_what_does_not_fit_is_said(kros, lifted, field, tmp_path) -> None:
    data, out = field(unit="deg"), tmp_path / "x.csv"

    def refused(*words: str, data: Path = data, more: tuple[str, ...] = ()) -> None:
        result = kros("estimate", lifted, data, out, *more)
        assert result.exit_code == 2, result.output
        assert all(word in result.stderr for word in words), result.stderr
        assert not out.exists()

    refused("position", "'rad'", "'deg'", "scale")
    refused("there is no file", "TOML with [data]", data=tmp_path / "logged")
    text = data.read_text().replace("deg", "rad")
    data.write_text(text.replace('{ name = "target_velocity", role = "input", column = "target_velocity" },', ""))
    refused("target_velocity is missing")
    data.write_text(text.replace('time = "t"', "sample_period_s = 0.002"))
    refused("0.001 s", "0.002 s")
    data.write_text(text)
    refused("UNIT.NAME=VALUE", more=("--parameter", "nobody.phase=1"))
    refused("parameters are phase", more=("--track", "lag"))


def test_check_says_what_it_can_without_hidden_channels(kros, demo, field) -> None:
    """The simulator knows which drive is badly assembled."""
    data = field()
    result = kros("check", demo, data, "--json")
    rows = {row["unit"]: row for row in json.loads(result.stdout)}
    assert list(rows) == ["m000000", "m001001", "m001002"]
    for row in rows.values():
        assert row["score"] is None
        assert row["missing"] == ["velocity", "current"]
        stated = row["status"], row["outlier"], row["level_units"]
        assert stated == ("cannot tell", False, 5)  # too few units for a verdict
    bad, *good = (row["level_db"] for row in rows.values())
    assert bad > max(0.0, max(good) + 1.0)
    assert result.exit_code == 4
    lines = kros("check", demo, data).stdout.splitlines()
    assert [line.split() for line in lines[::2]] == [["UNDECIDED", unit] for unit in rows]
    assert all("without velocity, current" in line for line in lines[1::2])
    assert all("the monitor's bound, from 5 units" in line for line in lines[1::2])


@pytest.mark.parametrize(("gain", "code", "word"), [(-1e-4, 0, "SAFE"), (-1e3, 3, "NOT SAFE")])
def test_a_controller_over_the_demo_is_judged(kros, demo, tmp_path, gain, code, word) -> None:
    file = tmp_path / "controller.json"
    content = {"D": [[gain]], "sample_period_s": 0.001, "inputs": ["velocity"], "outputs": ["target_velocity"]}
    file.write_text(json.dumps(content))
    command = ["loop", demo, "--controller", file, "--observer", "linear/worst_case_h2"]
    result = kros(*command, *([] if code else ["--json"]))
    assert result.exit_code == code, result.output
    if code:
        assert result.stdout.startswith(f"{word}: ")
    else:
        said = json.loads(result.stdout)
        assert said["status"] == word
        assert all(radius < 1 for radius in said["spectral_radius"].values())
        assert 1 < said["margin"] <= said["destabilising"]
    for changed in (content | {"poles": 1}, content | {"inputs": ["speed"]}, content | {"D": [[gain, 0.0]]}):
        file.write_text(json.dumps(changed))
        assert kros("loop", demo, "--controller", file).exit_code == 2
