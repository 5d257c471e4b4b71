"""Steps of a study: run in order, skipped where nothing has changed, resumed where a run was interrupted."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256

import numpy as np

from ...data.checks import NonFiniteError
from ...data.population import EpisodeKey, Population
from ..config import Stage, StudyConfig
from .context import Context
from .store import code_key, hash_of, source_key

log = logging.getLogger(__name__)


def always(config: StudyConfig) -> bool:
    """Tell that a stage is part of every study."""
    return True


@dataclass(frozen=True)
class StageStep:
    """One stage: what it does, which sections of the study, or ``section.key``, it depends on beside the stages before it, and which studies have it."""

    stage: Stage
    run: Callable[[Context], None]
    sections: tuple[str, ...]
    wanted: Callable[[StudyConfig], bool] = always


def run_steps(context: Context, steps: Sequence[StageStep], until: Stage) -> None:
    """Run steps up to a stage, from the first one that is not current; what later ones left goes where it is not current any more."""
    key, ahead = code_key(), False
    try:
        for position, step in enumerate(steps):
            if not step.wanted(context.config):
                context.store.erase(step.stage)
            elif not ahead:
                key = _run_step(context, steps[position:], key)
            elif context.store.is_current(step.stage, own := _key(context, step, key)):
                key = _next_key(context, step.stage, own)
            else:
                _outdate(context, steps[position:])
                break
            ahead = ahead or step.stage is until
        context.store.keep("study.json", context.config.dump())
    finally:
        context.store.tidy()


def _run_step(context: Context, steps: Sequence[StageStep], upstream: str) -> str:
    """Run the first of some steps, or find it done; return what the next one depends on."""
    stage = steps[0].stage
    key = _key(context, steps[0], upstream)
    if context.store.is_current(stage, key):
        record = context.store.record(stage)
        context.work.progress.finish(stage.value, record.seconds if record is not None else 0.0, skipped=True)
        return _next_key(context, stage, key)
    began = time.perf_counter()
    context.work.progress.start(stage.value, None)
    with context.store.drafting() as draft:
        steps[0].run(replace(context, store=draft))
        seconds = time.perf_counter() - began
        _outdate(context, steps)
        draft.commit(stage, key, seconds)
    context.work.progress.finish(stage.value, seconds, skipped=False)
    log.info("%s: %.2f s", stage.value, seconds)
    return _next_key(context, stage, key)


def _next_key(context: Context, stage: Stage, key: str) -> str:
    return hash_of([key, context.store.output_key(stage)])


def _outdate(context: Context, steps: Sequence[StageStep]) -> None:
    """Remove what does not follow from the study any more; from here on the run folder is that of the study as it is now."""
    context.store.discard("metrics.json")
    for step in steps:
        if step.wanted(context.config):
            context.store.clear(step.stage)
        else:
            context.store.erase(step.stage)
    context.store.keep("study.json", context.config.dump())


def _key(context: Context, step: StageStep, upstream: str) -> str:
    dumped = context.config.dump()
    dumped |= {
        f"{section}.{key}": value
        for section, table in dumped.items()
        if isinstance(table, dict)
        for key, value in table.items()
    }
    inputs = _inputs_key(context) if step.stage is Stage.READ else ""
    return hash_of([upstream, inputs, {name: dumped[name] for name in step.sections}])


def _inputs_key(context: Context) -> str:
    given = context.given
    if given is None:
        return source_key(context.config.data.source)
    declared = repr((given.columns, given.sample_period_s, given.units, sorted(given.metadata.items())))
    return hash_of([declared, [[str(k), _digest(given, k)] for k in given.episodes]])


def _digest(given: Population, key: EpisodeKey) -> str:
    """Return a digest of an episode; of one that is not finite, what is said of it: it is dropped, or an error."""
    try:
        return sha256(np.ascontiguousarray(given.source(key)).tobytes()).hexdigest()
    except NonFiniteError as error:
        return str(error)
