"""The demo command, alone: it simulates, runs the whole study, says where the report is, and goes on where it was."""

import json

FAST = (
    "identify.refine=false",
    "uncertainty.n_freqs=60",
    "uncertainty.max_order=1",
    "synthesis.input_weight=3.0",
    "evaluate.monte_carlo=0",
)


def test_the_demo_command_runs_everything_and_says_where_the_report_is(kros, tmp_path):
    out = tmp_path / "demo"
    options = [
        "--out",
        out,
        "--units",
        3,
        "--episodes",
        2,
        "--seconds",
        5,
        "--workers",
        1,
        *(part for key in FAST for part in ("--set", key)),
    ]
    result = kros("demo", *options)
    assert result.exit_code == 0, result.output
    assert f"report: {out / 'report.html'}" in result.stdout
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["study"]["units"] == 3
    (out / "notes.txt").write_text("remember")
    again = kros("demo", *options)
    assert again.exit_code == 0, again.output
    assert again.stderr.count("unchanged") == len(metrics["timing_s"]) - 1
    assert (out / "notes.txt").read_text() == "remember"
    assert json.loads((out / "metrics.json").read_text()) == metrics
