"""What a run folder holds, for people at a terminal."""

from __future__ import annotations

from pathlib import Path

from ...core.artifacts import load_artifact, read_json
from ..config import Stage
from ..engine.run_folder import open_finished
from ..pipeline import RunResult
from .summary import summary_lines


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
