"""A few lines for people at a terminal: about a run, and about what is installed."""

from __future__ import annotations

import platform
import shutil
from importlib import metadata
from pathlib import Path

from ...core.artifacts import load_artifact
from ...report.error_tables import ErrorCell
from ...report.facts import Facts
from ...report.verdict import judge
from ..config import Stage
from ..engine.store import METRICS, open_finished
from ..pipeline import RunResult

_REQUIRED = ("numpy", "scipy", "sympy", "pyarrow", "pydantic", "typer", "jinja2", "matplotlib")
_OPTIONAL = {
    "distributed": "maps over units on a cluster (kros run --scheduler)",
    "pandas": "reading long data frames",
    "scikit-learn": "the estimator protocol",
    "control": "exchange with python-control",
    "fmpy": "checking exported FMUs",
}


def diagnose() -> list[str]:
    """Return lines for people."""
    system = f"Python {platform.python_version()} on {platform.platform(terse=True)}"
    lines = [f"kros {_version('kros', 'not installed as a package')}   {system}"]
    lines += [f"  {name:<16} {_version(name, 'MISSING: install kros again')}" for name in _REQUIRED]
    lines += ["optional", *(f"  {name:<16} {_version(name, 'not installed')}   {of}" for name, of in _OPTIONAL.items())]
    compiler = shutil.which("cc") or shutil.which("gcc") or "none"
    return [*lines, f"C compiler        {compiler}   for checking exported C code"]


def _version(name: str, otherwise: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return otherwise


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
    rows = [("", list(hidden), "")]
    for name in sorted(table.cells, key=lambda name: table.mean(name, hidden)):
        mark = "  <- deployed" if name == facts.deployed else ""
        rows.append((name, [_error(table.cells[name].get(channel)) for channel in hidden], mark))
    width, wide = max(len(name) for name, _, _ in rows), max(12, *(len(c) + 2 for c in hidden))
    lines = [f"{name:<{width}}  " + "".join(f"{t:>{wide}}" for t in texts) + mark for name, texts, mark in rows]
    return ["observers by mean error on held-out episodes, percent of the largest value:", *lines]


def _error(cell: ErrorCell | None) -> str:
    if cell is None:
        return "–"
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
