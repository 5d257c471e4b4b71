"""`kros check` on machines whose condition is known: recorded less, in other episodes, by one that took part, under another name."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from kros.core import ConfigError
from kros.data import Channel, Role, from_arrays, write_parquet
from kros.study import RunResult

pytestmark = pytest.mark.usefixtures("low_order_weights")
PERIOD_S = 0.01
CHANNELS = (
    Channel("position", Role.STATE, "rad", True),
    Channel("velocity", Role.STATE, "rad/s", False),
    Channel("torque", Role.INPUT, "", True),
)
BATCH = {f"b{k:02d}": k for k in range(12)}
STUDY = """
[data]
source = "{source}"
reader = "parquet"
[identify]
refine = false
alpha = 30.0
[uncertainty]
form = "additive"
n_freqs = 60
"""


def drive(seed: int, bad: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """A drive under position control; a bad one has twice the torque and a spring half as stiff: four times the gain."""
    inertia, friction, torque, stiffness = np.array([1.0, 3.0, 40.0, 60.0]) * np.exp(
        0.05 * np.random.default_rng([1, seed]).normal(size=4)
    )
    if bad:
        torque, stiffness = 2 * torque, 0.5 * stiffness
    a = np.array([[0.0, 1.0], [-stiffness / inertia, -friction / inertia]])
    step = expm(np.block([[a, np.array([[0.0], [torque / inertia]])], [np.zeros((1, 3))]]) * PERIOD_S)
    return step[:2, :2], step[:2, 2:]


def episode(system: tuple[np.ndarray, np.ndarray], samples: int, *seed: int) -> np.ndarray:
    """Noise in, disturbed states out, measured with noise."""
    rng = np.random.default_rng([2, *seed])
    u, x = np.repeat(rng.normal(size=-(-samples // 10)), 10)[:samples], np.zeros((samples, 2))
    for k in range(samples - 1):
        x[k + 1] = system[0] @ x[k] + system[1][:, 0] * u[k] + (0.0, 0.05 * rng.normal())
    return np.column_stack([x + rng.normal(size=x.shape) * (1e-4, 1e-2), u])


def recordings(
    folder: Path, drives: Mapping[str, int], episodes: int, samples: int, bad: bool = False, first: int = 0
) -> Path:
    data = {u: [episode(drive(s, bad), samples, s, first + e) for e in range(episodes)] for u, s in drives.items()}
    write_parquet(from_arrays(data, CHANNELS, PERIOD_S), folder)
    return folder


@pytest.fixture(scope="module")
def run(kros, tmp_path_factory) -> Path:
    """A study of twelve drives, ten episodes each, regularised as much as it needs not to be, so that the amount of data matters."""
    folder = tmp_path_factory.mktemp("check")
    source = recordings(folder / "batch", BATCH, 10, 400)
    (folder / "study.toml").write_text(STUDY.format(source=source))
    result = kros("run", folder / "study.toml", "--out", folder / "run", "--until", "quantify")
    assert result.exit_code == 0, result.output
    return folder / "run"


@pytest.fixture
def checked(kros, run, tmp_path):
    def check(data: Path, *options: str) -> list[dict[str, Any]]:
        result = kros("check", run, data, "--json", *options)
        assert result.exit_code in (0, 3, 4), result.output
        rows = json.loads(result.stdout)
        words = {r["verdict"] for r in rows}
        assert result.exit_code == (3 if "FAIL" in words else 4 if "UNDECIDED" in words else 0)
        return rows

    return check


NEW = {f"n{k}": 100 + k for k in range(5)}


@pytest.mark.parametrize(("episodes", "samples"), [(10, 400), (3, 400), (1, 400), (12, 100), (2, 100)])
def test_good_units_are_not_flagged_for_being_recorded_less(checked, tmp_path, episodes, samples) -> None:
    """Five units: at 0.3 percent one alarm among the 25 of all cases has a probability of 7 percent, so the seeds are fixed."""
    rows = checked(recordings(tmp_path / "new", NEW, episodes, samples))
    assert not any(r["outlier"] for r in rows)
    for row in rows:
        assert row["status"] in ("ok", "cannot tell", "not enough data")
        assert row["episodes"] == episodes
        assert row["recorded_s"] == pytest.approx(episodes * samples * PERIOD_S, rel=0.02)
        assert (row["needed_s"] > 1.01 * row["recorded_s"]) == (row["status"] == "not enough data")
        assert row["status"] != "ok" or 0 < row["detectable"]["velocity"] <= 100
    assert {r["status"] == "not enough data" for r in rows} == {episodes * samples < 2000}


def test_a_score_that_decides_nothing_is_the_true_one(checked, tmp_path) -> None:
    rows = checked(recordings(tmp_path / "bad", NEW, 2, 100, bad=True))
    assert {(r["status"], r["outlier"]) for r in rows} == {("not enough data", False)}
    assert any(r["score"] > r["threshold"] for r in rows)


def test_a_channel_of_a_new_unit_that_is_unlike_those_of_the_study_is_named(checked, tmp_path, caplog) -> None:
    wrong = [episode(drive(100), 400, 100, e) * (1.0, 30.0, 1.0) for e in range(6)]
    good = [episode(drive(101), 400, 101, e) for e in range(6)]
    write_parquet(from_arrays({"n0": wrong, "n1": good}, CHANNELS, PERIOD_S), tmp_path / "new")
    checked(tmp_path / "new")
    (alert,) = (text for text in caplog.messages if "unit" in text.lower())
    assert alert.startswith("Unit n0: velocity moves ")
    assert alert.endswith("times as much as in most units; check its column and unit of measure.")


def test_bad_units_are_found(checked, run, tmp_path) -> None:
    data = recordings(tmp_path / "bad", NEW, 6, 400, bad=True)
    rows = checked(data)
    assert sum(r["outlier"] for r in rows) >= 4
    check = RunResult(run, {}).check(data)
    assert check.rows == rows
    assert check.summary().splitlines()[1].startswith("n0  FAIL, ")
    with pytest.raises(ConfigError, match="a Check has no figure"):
        check.plot()


def test_the_terminal_says_what_would_have_been_seen(kros, run, tmp_path) -> None:
    good = kros("check", run, recordings(tmp_path / "a", NEW, 10, 400))
    assert good.exit_code == 0
    lines = good.stdout.splitlines()
    assert [line.split() for line in lines[::2]] == [["PASS", unit] for unit in NEW]
    assert all("would be detected" in line for line in lines[1::2])
    data, files = recordings(tmp_path / "b", NEW, 2, 100), [tmp_path / f"units.{end}" for end in ("xml", "csv", "html")]
    short = kros("check", run, data, *(word for file in files for word in ("--out", file)))
    assert short.exit_code == 4
    with files[1].open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["verdict"], row["unit"]) for row in rows] == [("UNDECIDED", unit) for unit in NEW]
    assert all("are needed, found 1.9" in row["reason"] for row in rows)
    assert files[2].read_text().count(">UNDECIDED</td>") == 5
    assert all("are needed, found 1.9" in line for line in short.stdout.splitlines()[1::2])
    assert (tmp_path / "units.xml").read_text().count('<error type="UNDECIDED"') == 5
    assert kros("check", run, tmp_path / "b", "--out", tmp_path / "no" / "units.xml").exit_code == 2
    assert kros("check", run, tmp_path / "b", "--out", tmp_path / "units.doc").exit_code == 2


def test_units_of_the_study_are_not_held_against_themselves(checked, tmp_path) -> None:
    some = {u: BATCH[u] for u in ("b01", "b07")}
    own = checked(recordings(tmp_path / "own", some, 10, 400))
    assert [r["left_out"] for r in own] == [["b01"], ["b07"]]
    renamed = checked(recordings(tmp_path / "renamed", {f"x{u}": s for u, s in some.items()}, 10, 400))
    assert [r["left_out"] for r in renamed] == [["b01"], ["b07"]]
    np.testing.assert_allclose([r["score"] for r in renamed], [r["score"] for r in own], rtol=1e-6)
    part = checked(recordings(tmp_path / "part", {"y": BATCH["b03"]}, 3, 400))
    assert [r["left_out"] for r in part] == [["b03"]]
    again = recordings(tmp_path / "fresh", {"b01": BATCH["b01"], "z": 200}, 10, 400, first=50)
    fresh = checked(again, "--same-unit")
    assert [r["left_out"] for r in fresh] == [["b01"], []]


def test_a_name_of_the_study_with_other_recordings_is_refused(kros, run, tmp_path) -> None:
    """Another drive of that name would take the study's own unit out of the comparison."""
    refused = kros("check", run, recordings(tmp_path / "named", {"b01": 300}, 10, 400))
    assert refused.exit_code == 2
    assert "unit b01" in refused.stderr
    assert "--same-unit" in refused.stderr


def test_a_batch_of_unequal_recordings(kros, tmp_path) -> None:
    """A third of the units was recorded in two of ten episodes: none is flagged for that, and none blinds the others."""
    data = {u: [episode(drive(s), 400, s, e) for e in range(10 if s < 8 else 2)] for u, s in BATCH.items()}
    write_parquet(from_arrays(data, CHANNELS, PERIOD_S), tmp_path / "mixed")
    (tmp_path / "study.toml").write_text(STUDY.format(source=tmp_path / "mixed"))
    result = kros("run", tmp_path / "study.toml", "--out", tmp_path / "run", "--until", "quantify")
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "run" / "metrics.json").read_text())["outliers"]
    assert not any(r["outlier"] for r in rows)
    assert {r["episodes"] for r in rows} == {2, 10}
