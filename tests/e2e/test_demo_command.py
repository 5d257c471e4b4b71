"""The demo command, alone: it simulates, runs the whole study, says where the report is, and goes on where it was."""

import json
import re

FAST = ("identify.refine=false", "uncertainty.n_freqs=60", "synthesis.methods=[]", 'observer.baselines=["open_loop"]')


def test_the_demo_command_runs_everything_and_says_where_the_report_is(kros, few_figures, low_order_weights, tmp_path):
    out = tmp_path / "demo"
    size = ("--units", 3, "--episodes", 2, "--seconds", 5)
    options = ["--out", out, *size, *(part for key in FAST for part in ("--set", key))]
    result = kros("demo", *options)
    assert result.exit_code == 0, result.output
    assert re.search(rf"report +{re.escape(str(out / 'report.html'))}", result.stdout)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["study"]["units"] == 3
    (out / "notes.txt").write_text("remember")
    again = kros("demo", *options)
    assert again.exit_code == 0, again.output
    assert again.stderr.count("unchanged") == len(metrics["timing_s"]) - 1
    assert (out / "notes.txt").read_text() == "remember"
    assert json.loads((out / "metrics.json").read_text()) == metrics
