"""The pipeline: stages in order, skipped where nothing has changed, resumed where a run was interrupted."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.artifacts import read_json, write_json
from ..core.errors import ConfigError, DataError, DimensionError
from .config import Stage, StudyConfig
from .context import Context, Progress, Silent
from .executors import open_executor
from .metrics import collect_metrics
from .stages import calibrate, evaluate, identify, quantify, read, report, synthesize
from .store import Store, code_key, hash_of, remove_tree, source_key

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Step:
    """One stage: what it does and which sections of the study it depends on, beside the stages before it."""

    stage: Stage
    run: Callable[[Context], list[Path]]
    sections: tuple[str, ...]


STEPS = (
    Step(Stage.READ, read.run, ("data", "split")),
    Step(Stage.CALIBRATE, calibrate.run, ("calibrate", "lifting")),
    Step(Stage.IDENTIFY, identify.run, ("identify", "lifting")),
    Step(Stage.QUANTIFY, quantify.run, ("uncertainty",)),
    Step(Stage.SYNTHESIZE, synthesize.run, ("synthesis", "observer")),
    Step(Stage.EVALUATE, evaluate.run, ()),
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
    out: Path,
    until: Stage = Stage.REPORT,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> RunResult:
    """Run a study into a folder.

    Parameters
    ----------
    config : StudyConfig
    out : Path
        Run folder; a stage that finds its own earlier result there is skipped.
    until : Stage
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
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"Output {out}: is a file; name a folder.")
    fresh = not out.exists() or not any(out.iterdir())
    if not fresh and not (out / "study.json").exists():
        raise ConfigError(f"Output {out}: is a folder with other content; name a new folder or an earlier run.")
    read.check_source(config, single_allowed=list(Stage).index(until) <= list(Stage).index(Stage.IDENTIFY))
    store = Store(out)
    try:
        with open_executor(workers, scheduler) as executor:
            context = Context(config, store, executor, progress or Silent())
            if fresh:
                write_json(store.path("study.json"), config.dump())
            _run_steps(context, until)
    except (ConfigError, DataError, DimensionError):
        remove_tree(store.path(read.PARTIAL))
        if fresh and not store.record(Stage.READ):
            remove_tree(out)
        raise
    metrics = collect_metrics(context, until, time.perf_counter() - began)
    write_json(store.path("metrics.json"), metrics)
    return RunResult(out, metrics, violations(config, metrics))


def _run_steps(context: Context, until: Stage) -> None:
    key = code_key()
    for position, step in enumerate(STEPS):
        key = _key(context, step, key)
        if context.store.is_current(step.stage, key):
            record = context.store.record(step.stage) or {}
            context.progress.finish(step.stage.value, record["seconds"], skipped=True)
        else:
            began = time.perf_counter()
            context.progress.start(step.stage.value, None)
            files = _perform(context, position)
            seconds = time.perf_counter() - began
            context.store.finish(step.stage, key, seconds, files)
            context.progress.finish(step.stage.value, seconds, skipped=False)
            log.info("%s: %.2f s", step.stage.value, seconds)
        if step.stage is Stage.READ:
            write_json(context.store.path("study.json"), context.config.dump())
            context.store.path("metrics.json").unlink(missing_ok=True)
        key = hash_of([key, context.store.output_key(step.stage)])
        if step.stage is until:
            return


def _perform(context: Context, position: int) -> list[Path]:
    """Run a stage in place of its earlier result and of all that follow from it."""
    step = STEPS[position]
    if step.stage is not Stage.READ:
        _clear(context, position)
        return step.run(context)
    files = step.run(context)  # before anything is cleared: recordings that turn out bad leave an earlier run as it was
    _clear(context, position + 1)
    return files


def _clear(context: Context, position: int) -> None:
    for step in STEPS[position:]:
        context.store.clear(step.stage)


def _key(context: Context, step: Step, upstream: str) -> str:
    dumped = context.config.dump()
    inputs = source_key(context.config.data.source) if step.stage is Stage.READ else ""
    return hash_of([upstream, inputs, {name: dumped[name] for name in step.sections}])


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
