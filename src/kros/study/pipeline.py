"""A whole study in a run folder, and what it leaves behind."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.artifacts import read_json, write_json
from ..core.errors import ConfigError, DataError, DimensionError
from .config import Stage, StudyConfig
from .context import Context, Progress, Silent
from .executors import open_executor
from .metrics import collect_metrics
from .stages import evaluate, left_out, read, report
from .steps import LEARNING, Step, run_steps
from .store import Store, remove_tree

STEPS = (
    *LEARNING,
    Step(Stage.EVALUATE, evaluate.run, ("evaluate", "load")),
    Step(Stage.LEFT_OUT, left_out.run, ("evaluate",), left_out.wanted),
    Step(Stage.REPORT, report.run, ("name", "require")),
)


@dataclass(frozen=True)
class RunResult:
    """What a run left behind."""

    folder: Path
    metrics: dict[str, Any]
    violations: tuple[str, ...]


def run_study(
    config: StudyConfig,
    out: Path | str,
    until: Stage | str = Stage.REPORT,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> RunResult:
    """Run a study into a folder.

    Parameters
    ----------
    config : StudyConfig
    out : Path or str
        Run folder; a stage that finds its own earlier result there is skipped.
    until : Stage or str
        Last stage to run.
    workers : int
        Processes for maps over units. More than one needs the usual ``if __name__ == "__main__":`` guard in a script.
    scheduler : str, optional
        Address of a Dask scheduler, instead of processes.
    progress : Progress, optional
        Told which stage runs and how far it is.

    Returns
    -------
    RunResult

    Raises
    ------
    KrosError
        Bad input leaves no folder behind that was not there before.
    """
    began = time.perf_counter()
    out, until = Path(out), stage_of(until)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"Output {out}: is a file; name a folder.")
    fresh = not out.exists() or not any(out.iterdir())
    if not fresh and not (out / "study.json").exists():
        raise ConfigError(f"Output {out}: is a folder with other content; name a new folder or an earlier run.")
    read.check_source(config, single_allowed=list(Stage).index(until) <= list(Stage).index(Stage.IDENTIFY))
    if left_out.wanted(config):
        left_out.check_folds(config, read.open_source(config))
    store = Store(out)
    try:
        with open_executor(workers, scheduler) as executor:
            context = Context(config, store, executor, progress or Silent())
            if fresh:
                write_json(store.path("study.json"), config.dump())
            run_steps(context, STEPS, until)
    except (ConfigError, DataError, DimensionError):
        remove_tree(store.path(read.PARTIAL))
        if fresh and not store.record(Stage.READ):
            remove_tree(out)
        raise
    metrics = collect_metrics(context, until, time.perf_counter() - began)
    write_json(store.path("metrics.json"), metrics)
    return RunResult(out, metrics, violations(config, metrics))


def stage_of(name: Stage | str) -> Stage:
    """Return a stage by its name."""
    try:
        return Stage(name)
    except ValueError as error:
        raise ConfigError(f"Stage {name!r}: is unknown; known are {', '.join(stage.value for stage in Stage)}.") from error


def violations(config: StudyConfig, metrics: dict[str, Any]) -> tuple[str, ...]:
    """Return the requirements of the study that its result does not meet."""
    found = []
    deployed = metrics.get("observers", {}).get(metrics["study"].get("deployed") or "", {})
    if config.require.robust and (deployed.get("status") == "failed" or deployed.get("worst_case_h2") is None):
        reason = deployed.get("reason", "none was computed")
        found.append(f"require.robust: the deployed observer {metrics['study'].get('deployed')} has no certificate ({reason})")
    flagged = [f"{row['unit']} ({row['condition']})" for row in metrics.get("outliers", []) if row["outlier"]]
    if config.require.no_outliers and flagged:
        found.append(f"require.no_outliers: flagged are {', '.join(flagged)}")
    return tuple(found)


def load_run(folder: Path) -> tuple[StudyConfig, Store]:
    """Open a finished run folder.

    Raises
    ------
    ConfigError
        When the folder is not a run.
    """
    folder = Path(folder)
    if not (folder / "study.json").exists():
        raise ConfigError(f"Run {folder}: there is no study.json in it; name the folder that kros run or kros demo wrote.")
    return StudyConfig.model_validate(read_json(folder / "study.json")), Store(folder)
