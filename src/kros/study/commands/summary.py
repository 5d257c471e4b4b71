"""A few lines for people at a terminal: about a run, and about what is installed."""

import platform
import shutil
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from ...core import ConfigError, Record
from ...loops.compiler import COMPILERS
from ...report.compare import aligned, compared, differences, lines
from ...report.facts import Facts
from ..config import Stage
from ..engine.context import open_finished
from ..engine.store import METRICS
from ..pipeline import RunResult

_REQUIRED = ["numpy", "scipy", "sympy", "pyarrow", "pydantic", "typer", "jinja2", "matplotlib"]
_PACKAGES = dict.fromkeys(_REQUIRED, "required") | {
    "distributed": "optional, for maps over units on a cluster (kros run --scheduler)",
    "pandas": "optional, for reading long data frames",
    "scikit-learn": "optional, for the estimator protocol",
    "control": "optional, for exchange with python-control",
    "fmpy": "optional, for checking exported FMUs",
}


def diagnose() -> list[str]:
    """Return lines for people."""
    rows = [f"kros {_version('kros')}   Python {platform.python_version()} on {platform.platform(terse=True)}"]
    rows += [f"  {name:<16} {_version(name):<14} {of}" for name, of in _PACKAGES.items()]
    compiler = next(filter(None, map(shutil.which, COMPILERS)), "none")
    return [*rows, f"C compiler        {compiler}   for batch runs, and for checking exported C code"]


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "NOT INSTALLED"


def ranking(facts: Facts) -> list[str]:
    """Return one line an observer, the smallest error of the hidden channels first."""
    table, hidden = facts.table, facts.table.hidden
    rows = []
    for name in sorted(table.cells, key=lambda name: table.mean(name, hidden)):
        means = {channel: cell.shown for channel, cell in table.cells[name].items()}
        rows.append((f"{name}{'  <- deployed' if name == facts.deployed else ''}", *map(means.get, hidden)))
    title = f"observers by mean error on held-out episodes{facts.home}, percent of the largest value:"
    return [title, *aligned([("", *hidden), *rows])] if rows else []


def list_run(run: Path) -> list[str]:
    """Return what was studied, which stages are done, the observers in the order of their errors, and the verdict."""
    with open_finished(run) as context:
        config, store, manifest = context.config, context.store, context.store.manifest
        done = [f"{stage} {manifest[stage].seconds:.3g} s" for stage in Stage if stage in manifest]
        lines = [f"study {config.name} of {config.data.source}", f"stages done: {', '.join(done) or 'none'}"]
        if store.path(METRICS).exists():
            result = RunResult(store.folder, store.metrics())
            return lines + ranking(Facts(result.metrics)) + result.summary().splitlines()[1:]
        if Stage.SYNTHESIZE in manifest:
            lines += [f"observers: {', '.join(context.observers_record['names'])}"]
        return [*lines, "the run has not ended; the same command of kros run goes on with it"]


def compare_runs(runs: Sequence[Path]) -> tuple[Record, list[str]]:
    """Return in what finished runs differ, as content of JSON and as lines."""
    if len(set(runs)) < 2:
        raise ConfigError(f"Compare: at least two runs are needed, found {len(set(runs))}; name another run folder.")
    names = [run.name for run in runs] if len({run.name for run in runs}) == len(runs) else list(map(str, runs))
    read = []
    for run in runs:
        with open_finished(run) as context:
            if not (run / METRICS).exists():
                raise ConfigError(f"Run {run}: has not ended; the same command of kros run goes on with it.")
            read.append(compared(context.config.dump(), Facts(context.store.metrics())))
    differing = differences(read)
    return {"runs": names, **differing}, lines(names, differing)
