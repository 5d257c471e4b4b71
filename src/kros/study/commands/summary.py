"""A few lines about a run for people at a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...core.artifacts import load_artifact, read_json
from ...report.caveats import confounded_text
from ..config import Stage
from ..engine.run_folder import open_finished
from ..pipeline import RunResult


def summary_lines(result: RunResult) -> list[str]:
    """Return what was found and where the report is."""
    metrics = result.metrics
    study = metrics["study"]
    lines = [
        f"{study['units']} units, conditions {', '.join(study['conditions'])}, {metrics['timing_s']['total']:.1f} s in all"
    ]
    lines += [f"look at: {alert}" for alert in study.get("alerts", ())]
    lines += [*confounded_text(metrics), *observer_lines(result)]
    flagged = sorted({f"{row['unit']} ({row['condition']})" for row in metrics.get("outliers", []) if row["outlier"]})
    if "outliers" in metrics:
        lines.append(f"flagged as outliers: {', '.join(flagged) if flagged else 'none'}{_silent(metrics['outliers'])}")
    report = result.folder / "report.html"
    lines.append(f"report: {report}" if report.exists() else f"results: {result.folder}")
    return lines


def _silent(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return how many scores say nothing about their unit."""
    silent = sum(row.get("status") in ("not enough data", "cannot tell") for row in rows)
    return f"; {silent} of {len(rows)} scores say nothing about their unit" if silent else ""


def observer_lines(result: RunResult) -> list[str]:
    """Return one line an observer: mean error of all units in the condition that was identified on."""
    metrics = result.metrics
    rows = [
        r
        for r in metrics.get("evaluation", [])
        if r["condition"] == metrics["study"]["identify_on"] and r["role"] != "outlier"
    ]
    channels = list(dict.fromkeys(r["channel"] for r in rows))
    if not rows:
        return []
    width = max(len(r["observer"]) for r in rows)
    wide = {c: max(12, len(c) + 2) for c in channels}
    lines = [
        "mean error over all units, in percent of the largest value:",
        f"{'':<{width}}  " + "".join(f"{c:>{wide[c]}}" for c in channels),
    ]
    for name in dict.fromkeys(r["observer"] for r in rows):
        means = []
        for channel in channels:
            values = [r["error_percent"] for r in rows if r["observer"] == name and r["channel"] == channel]
            known = "diverged" if None in values else f"{sum(values) / max(len(values), 1):.4g}"
            means.append(f"{known if values else '–':>{wide[channel]}}")  # some observers estimate one channel only
        mark = "  <- deployed" if name == metrics["study"].get("deployed") else ""
        lines.append(f"{name:<{width}}  {''.join(means)}{mark}")
    return lines


def list_run(run: Path) -> list[str]:
    """Return what was studied, which stages are done, which observers there are by name, and how well they do."""
    with open_finished(run) as (config, store):
        records = {stage.value: store.record(stage) for stage in Stage}
        done = [f"{name} {record.seconds:.3g} s" for name, record in records.items() if record is not None]
        lines = [f"study {config.name} of {config.data.source}", f"stages done: {', '.join(done) or 'none'}"]
        if store.is_kept("metrics.json"):
            return lines + summary_lines(RunResult(store.folder, read_json(store.path("metrics.json")), ()))
        if store.record(Stage.SYNTHESIZE) is not None:
            names = load_artifact(store.path("observers"), "observers")[0]["names"]
            lines += [f"observers: {', '.join(names)}"]
        return [*lines, "the run has not ended; the same command of kros run goes on with it"]
