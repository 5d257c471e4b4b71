"""The demo command, alone: it simulates, tunes, and says where the report is."""

import json


def test_the_demo_command_runs_everything_tunes_and_says_where_the_report_is(kros, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "kros.design.methods.disturbance_model._CORNERS_HZ", (1.0,)
    )  # eight candidates in place of sixteen: the search is the same
    out = tmp_path / "demo"
    result = kros("demo", "--out", out, "--units", 3, "--episodes", 2, "--seconds", 6, "--workers", 1)
    assert result.exit_code == 0, result.output
    assert f"report: {out / 'report.html'}" in result.stdout
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["study"]["units"] == 3
    observers = {name: o for name, o in metrics["observers"].items() if name.endswith(("worst_case_h2", "kalman_tuned"))}
    assert all("process_noise" in o or "process_noise_level" in o for o in observers.values())
    (out / "notes.txt").write_text("remember")
    again = kros("demo", "--out", out, "--units", 3, "--episodes", 2, "--seconds", 6, "--workers", 1)
    assert again.exit_code == 0, again.output
    assert again.stderr.count("unchanged") == len(metrics["timing_s"]) - 1
    assert (out / "notes.txt").read_text() == "remember"
    assert json.loads((out / "metrics.json").read_text()) == metrics
