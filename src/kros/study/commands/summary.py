"""A few lines about a run for people at a terminal."""

from __future__ import annotations

from pathlib import Path

from ...core.artifacts import load_artifact
from ...report.error_tables import ErrorCell
from ...report.facts import Facts
from ...report.verdict import judge
from ..config import Stage
from ..engine.run_folder import open_finished
from ..engine.store import METRICS
from ..pipeline import RunResult


def summary_lines(result: RunResult) -> list[str]:
    """Return the verdict, three numbers, and where the report is."""
    facts, report = Facts(result.metrics), result.folder / "report.html"
    if not facts.deployed:
        units = f"{facts.study['units']} units: no observer has been designed yet"
        return [units, *(f"check: {alert}" for alert in facts.study.get("alerts", ())), f"results: {result.folder}"]
    verdict = judge(facts)
    numbers = [f"{n.label} {n.value} {n.unit} ({n.notes[-1]})" for n in verdict.numbers]
    lines = [f"{verdict.status.value}: {verdict.sentence}", *(["; ".join(numbers)] if numbers else [])]
    return [*lines, f"report: {report}" if report.exists() else f"results: {result.folder}"]


def ranking(facts: Facts) -> list[str]:
    """Return one line an observer, the smallest error of the hidden channels first."""
    table = facts.table
    if table is None:
        return []
    hidden = table.hidden(facts.measured)
    names = sorted(table.cells, key=lambda name: table.mean(name, hidden))
    width, wide = max(map(len, names)), {c: max(12, len(c) + 2) for c in hidden}
    head = f"{'':<{width}}  " + "".join(f"{c:>{wide[c]}}" for c in hidden)
    lines = ["observers by mean error on held-out episodes, percent of the largest value:", head]
    for name in names:
        cells = [table.cells[name].get(c) for c in hidden]
        texts = ["–" if c is None else _error(c) for c in cells]
        mark = "  <- deployed" if name == facts.deployed else ""
        lines.append(
            f"{name:<{width}}  " + "".join(f"{t:>{wide[c]}}" for t, c in zip(texts, hidden, strict=True)) + mark
        )
    return lines


def _error(cell: ErrorCell) -> str:
    return "diverged" if cell.mean is None else f"{cell.mean:.4g}"


def list_run(run: Path) -> list[str]:
    """Return what was studied, which stages are done, the observers in the order of their errors, and the verdict."""
    with open_finished(run) as (config, store):
        records = {stage.value: store.record(stage) for stage in Stage}
        done = [f"{name} {record.seconds:.3g} s" for name, record in records.items() if record is not None]
        lines = [f"study {config.name} of {config.data.source}", f"stages done: {', '.join(done) or 'none'}"]
        if store.path(METRICS).exists():
            result = RunResult(store.folder, store.metrics())
            return lines + ranking(Facts(result.metrics)) + summary_lines(result)
        if store.record(Stage.SYNTHESIZE) is not None:
            names = load_artifact(store.path("observers"), "observers")[0]["names"]
            lines += [f"observers: {', '.join(names)}"]
        return [*lines, "the run has not ended; the same command of kros run goes on with it"]
