"""The demo: every stage does its work, and metrics.json keeps its contract."""

import json

import numpy as np
import pytest

from kros.core import DataError
from kros.identify import ModelSet
from kros.observer import Observer, run_observer
from kros.observer.sensor_gains import sensor_gains
from kros.plants.harmonic_drive.dynamics import VELOCITY_POLE

STAGES = ["read", "calibrate", "identify", "quantify", "synthesize", "evaluate", "report"]
FORMS = {
    "additive",
    "input_multiplicative",
    "output_multiplicative",
    "inverse_additive",
    "inverse_input_multiplicative",
    "inverse_output_multiplicative",
}
CHANNELS = {"position", "velocity", "current"}


def test_metrics_keep_the_contract(metrics):
    assert metrics["schema"] == 1
    study = metrics["study"]
    assert (study["units"], study["sample_period_s"]) == (5, 0.001)
    assert (study["conditions"], study["identify_on"]) == (["load", "noload"], "noload")
    assert study["alpha"] > 0
    assert metrics["observers"][study["deployed"]]["relift_certified"]
    assert metrics["observers"][study["deployed"]]["loss_error_percent"] < 300
    assert list(metrics["timing_s"]) == [*STAGES, "total"]
    assert {u["unit"]: u["group"] for u in metrics["units"]}["000000"] == "outliers"
    good = [u for u in metrics["units"] if u["group"] != "outliers"]
    assert all(u["status"] == "ok" and 0.9 < u["concentration"] <= 1 for u in good)
    assert list(metrics["models"]) == ["koopman", "linear"]
    for name, model in metrics["models"].items():
        assert model["order"] == {"koopman": 4, "linear": 3}[name]
        assert model["spectral_radius_max"] < 1
        assert set(model["freerun_error_percent"]) == CHANNELS
        assert all(0 < e["median"] <= e["worst"] < 60 for e in model["freerun_error_percent"].values())
    for uncertain in metrics["uncertainty"].values():
        assert set(uncertain["peak_db"]) == FORMS
        assert uncertain["weight"]["cover_max"] <= 1
        assert uncertain["weight"]["overbound_db_max"] <= 3
        assert [len(orders) for orders in uncertain["weight"]["orders"]] == [2, 2]
    for name in (f"{model}/worst_case_h2" for model in metrics["models"]):
        observer = metrics["observers"][name]
        assert 0 < observer["lower_bound"] <= observer["worst_case_h2"]
        assert observer["spectral_radius_max"] < 1
    assert len(metrics["outliers"]) == 12


def test_every_unit_is_evaluated_in_every_condition_with_every_observer(metrics):
    rows = {(r["observer"], r["unit"], r["condition"], r["channel"]) for r in metrics["evaluation"]}
    made = {name for name, o in metrics["observers"].items() if o.get("status") != "failed"}
    estimated = dict.fromkeys(made, CHANNELS)
    estimated |= {"filtered_difference": {"velocity"}, "learned": {"velocity", "current"}}
    assert "held-out episode" in metrics["observers"]["mean_profile"]["reason"]  # drives of a demo repeat no motion
    assert len(rows) == len(metrics["evaluation"]) == sum(len(channels) for channels in estimated.values()) * 6 * 2
    for name, channels in estimated.items():
        assert {channel for observer, *_, channel in rows if observer == name} == channels
    assert {r["role"] for r in metrics["evaluation"]} == {"nominal", "off_nominal", "outlier"}
    assert all(r["gearbox_band_power"] >= 0 for r in metrics["evaluation"] if r["error_percent"] is not None)


def test_estimates_and_recordings_are_judged_against_the_true_velocity_too(demo, metrics):
    """The drive's own velocity is a difference, half a sample late, behind a low-pass at 150 Hz, `pole / (1 - pole)` samples late."""
    late = 1e-3 * (0.5 + VELOCITY_POLE / (1 - VELOCITY_POLE))
    assert {(r["channel"], r["condition"]) for r in metrics["recorded"]} == {
        ("velocity", c) for c in ("noload", "load")
    }
    assert all(r["true_lag_s"] == pytest.approx(late, abs=0.1e-3) for r in metrics["recorded"])
    assert len(metrics["recorded"]) == 6 * 2
    assert "lag (ms)" in (demo / "report.html").read_text()
    rows = [r for r in metrics["evaluation"] if r["error_percent"] is not None]
    assert all(("true_error_percent" in r) == (r["channel"] == "velocity") for r in rows)


def test_the_models_on_disk_are_what_the_design_promises(demo, metrics, recorded):
    for name, order in (("koopman_edmd", 4), ("linear_edmd", 3)):
        content = json.loads((demo / "models" / name / "model.json").read_text())
        with np.load(demo / "models" / name / "arrays.npz", allow_pickle=False) as arrays:
            assert arrays["A"].shape == (6, order, order)
            assert arrays["B"].shape == (6, order, 2)
        assert len(content["unit_ids"]) == 6
        assert content["alpha"] == metrics["study"]["alpha"]
    koopman = ModelSet.load(demo / "models" / "koopman_edmd")
    truth = json.loads((recorded / "truth.json").read_text())["units"]
    found = np.array([koopman.parameters["phase"][koopman.index(u)] for u in truth])
    true = np.array([truth[u]["phase_rad"][0] for u in truth])
    error = np.angle(np.exp(2j * (found - true))) / 2
    np.testing.assert_allclose(error, 0, atol=0.05)
    branch = np.sign(np.cos(found - true))
    assert abs(branch.sum()) == len(branch)


def test_a_second_run_changes_nothing_and_skips_everything(kros, demo, metrics):
    files = [p for p in demo.rglob("*") if p.is_file() and p.name not in ("metrics.json", "study.json")]
    before = {p: p.stat().st_mtime_ns for p in files}
    result = kros("run", demo.parent / "demo.toml", "--out", demo)
    assert result.exit_code == 0, result.output
    assert result.stderr.count("unchanged") == len(STAGES)
    assert {p: p.stat().st_mtime_ns for p in before} == before
    again = json.loads((demo / "metrics.json").read_text())
    assert {k: v for k, v in again.items() if k != "timing_s"} == {k: v for k, v in metrics.items() if k != "timing_s"}


def test_the_deployed_observer_is_exported(kros, demo, tmp_path):
    result = kros("export", "c", demo, tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "differs from Python on a held-out episode by at most" in result.output
    for command in ("c", "fmu"):
        assert kros("export", command, demo, tmp_path / "other.fmu", "--observer", "nobody").exit_code == 2
    assert not (tmp_path / "other.fmu").exists()


@pytest.mark.parametrize(("command", "precision"), [("c", "float"), ("c", "double"), ("fmu", "float")])
def test_single_precision_that_was_not_compared_is_a_warning(
    kros, demo, tmp_path, monkeypatch, caplog, command, precision
):
    def gone(_):
        raise DataError("there are no recordings")

    monkeypatch.setattr("kros.study.engine.context.recordings_of", gone)
    out, observer = tmp_path / "out.fmu", ("--observer", "linear/worst_case_h2")  # without a monitor: a short self-test
    result = kros("export", command, demo, out, "--precision", precision, *observer)
    assert result.exit_code == 0, result.output
    assert out.exists()
    assert ("there are no recordings" in caplog.text) == (command == "c")
    assert ("single precision was not compared" in caplog.text) == (precision == "float")


def test_new_units_are_scored(kros, demo, recorded, tmp_path):
    """One of them has the name of a unit of the study. It makes no difference whether the study's own recordings are still there."""
    fresh = tmp_path / "new"
    size = ("--units", 2, "--episodes", 4, "--seconds", 8)
    assert kros("simulate", fresh, *size, "--seed", 77, "--outlier").exit_code == 0
    assert "unit 000000" in (refused := kros("check", demo, fresh)).stderr
    assert refused.exit_code == 2
    result = kros("check", demo, fresh, "--json", "--same-unit")
    scores = json.loads(result.stdout)
    units, conditions = ("000000", "001001", "001002"), ("noload", "load")
    assert {(r["unit"], r["condition"]) for r in scores} == {(u, c) for u in units for c in conditions}
    assert all(np.isfinite(r["score"]) for r in scores)
    assert result.exit_code == 4
    for row in scores:
        needed = f"needs about {row['fewest_units']} units" if row["fewest_units"] else "no number of units"
        assert (row["verdict"], row["threshold"], needed in row["reason"]) == ("UNDECIDED", None, True)
        assert (row["fewest_units"] or 8) >= 8
    recorded.rename(tmp_path / "elsewhere")
    try:
        assert kros("check", demo, fresh, "--json", "--same-unit").stdout == result.stdout
    finally:
        (tmp_path / "elsewhere").rename(recorded)


def test_the_report_says_what_sensor_the_deployed_observer_needs(demo, metrics):
    """Gains are told, and that of an offset is what the filter bank of the linear lifting makes of one at rest."""
    gains = metrics["deployment"]["sensor_gains"]["position"]
    assert gains["noise"].keys() == gains["bias"].keys() == {"position", "velocity", "current"}
    assert all(gains["bounded"][s] >= max(gains["noise"][s], 0.999 * gains["bias"][s]) > 0 for s in gains["noise"])
    assert "costs 1 % of the largest value" in (demo / "report.html").read_text(encoding="utf-8")
    observer = Observer.load(demo / "observers" / "linear" / "estimator.json")
    offsets = np.broadcast_to([[0.0], [1e-9]], (60_000, 2, 1))
    states = run_observer(observer, offsets, np.zeros((60_000, 2, 2)))[-1]
    told = sensor_gains(observer, dict.fromkeys(observer.recorded, 1.0))["position"]["bias"]
    np.testing.assert_allclose(np.abs(states[1] - states[0])[:3] / 1e-9, list(told.values()), rtol=1e-3)
