"""Steps of a study: run in order, skipped where nothing has changed, resumed where a run was interrupted."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..core.artifacts import write_json
from .config import Stage, StudyConfig
from .context import Context
from .stages import calibrate, identify, quantify, read, synthesize
from .store import code_key, hash_of, source_key

log = logging.getLogger(__name__)


def always(config: StudyConfig) -> bool:
    """Tell that a stage is part of every study."""
    return True


@dataclass(frozen=True)
class Step:
    """One stage: what it does, which sections of the study it depends on beside the stages before it, and which studies have it."""

    stage: Stage
    run: Callable[[Context], list[Path]]
    sections: tuple[str, ...]
    wanted: Callable[[StudyConfig], bool] = always


LEARNING = (
    Step(Stage.READ, read.run, ("data", "split")),
    Step(Stage.CALIBRATE, calibrate.run, ("calibrate", "lifting")),
    Step(Stage.IDENTIFY, identify.run, ("identify", "lifting")),
    Step(Stage.QUANTIFY, quantify.run, ("uncertainty",)),
    Step(Stage.SYNTHESIZE, synthesize.run, ("synthesis", "observer", "require")),
)
"""From recordings to observers."""


def run_steps(context: Context, steps: Sequence[Step], until: Stage) -> None:
    """Run steps up to a stage, from the first one that is not current."""
    key = code_key()
    for position, step in enumerate(steps):
        if not step.wanted(context.config):
            context.store.clear(step.stage)
        else:
            key = _run_step(context, steps[position:], key)
        if step.stage is until:
            return


def _run_step(context: Context, steps: Sequence[Step], upstream: str) -> str:
    """Run the first of some steps, or find it done; return what the next one depends on."""
    step = steps[0]
    key = _key(context, step, upstream)
    if context.store.is_current(step.stage, key):
        record = context.store.record(step.stage) or {}
        context.progress.finish(step.stage.value, record["seconds"], skipped=True)
    else:
        began = time.perf_counter()
        context.progress.start(step.stage.value, None)
        files = _perform(context, steps)
        seconds = time.perf_counter() - began
        context.store.finish(step.stage, key, seconds, files)
        context.progress.finish(step.stage.value, seconds, skipped=False)
        log.info("%s: %.2f s", step.stage.value, seconds)
    if step.stage is Stage.READ:
        write_json(context.store.path("study.json"), context.config.dump())
        context.store.path("metrics.json").unlink(missing_ok=True)
    return hash_of([key, context.store.output_key(step.stage)])


def _perform(context: Context, steps: Sequence[Step]) -> list[Path]:
    """Run a stage in place of its earlier result and of all that follow from it."""
    if steps[0].stage is not Stage.READ:
        _clear(context, steps)
        return steps[0].run(context)
    files = steps[0].run(context)  # before anything is cleared: recordings that turn out bad leave an earlier run as it was
    _clear(context, steps[1:])
    return files


def _clear(context: Context, steps: Sequence[Step]) -> None:
    for step in steps:
        context.store.clear(step.stage)


def _key(context: Context, step: Step, upstream: str) -> str:
    dumped = context.config.dump()
    inputs = source_key(context.config.data.source) if step.stage is Stage.READ else ""
    return hash_of([upstream, inputs, {name: dumped[name] for name in step.sections}])
