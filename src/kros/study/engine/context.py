"""What every stage gets, and the stages in order: each is run, or found done by the digest of what it follows from."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from ...core import Names, Record, digest_of, frozen, load_artifact, stamp_of, write_json
from ...core.work import Results, Work
from ...data import EpisodeKey, NonFiniteError, Population
from ...data.recording import digest_of as episode_digest
from ...identify import PhaseCalibration, PhaseSpec
from ...identify.identified import IdentifiedModels, recordings_of
from ...identify.presets import resolve_lifting, resolve_phase
from ...identify.survey import RecordingFacts
from ...lifting import Lifting
from ...observer import Observer
from ...uncertainty import UncertainModels
from ..config import Stage, StudyConfig
from .lock import locked
from .store import DEPLOYED, METRICS, STUDY, Store, code_key, load_run


@frozen
class Context:
    """What a stage gets: the study, its run folder, where work runs, and recordings that are given."""

    config: StudyConfig
    store: Store
    work: Work
    given: Population | None = None

    @cached_property
    def facts(self) -> RecordingFacts:
        """What the read stage found."""
        return RecordingFacts.load(self.store.path("population"))

    @cached_property
    def population(self) -> Population:
        """The prepared recordings of the units that take part."""
        return recordings_of(self.store.folder).select(self.facts.groups)

    @cached_property
    def lifting(self) -> Lifting:
        """The Koopman lifting of the study; without functions where none is declared and none suits the plant."""
        return resolve_lifting(self.config.lifting, self.config.calibrate, self.population, self.config.split.test)

    @cached_property
    def phase_spec(self) -> PhaseSpec | None:
        """What is calibrated, if anything."""
        return resolve_phase(self.config.calibrate, self.population, self.lifting)

    @cached_property
    def calibration(self) -> PhaseCalibration | None:
        """What the calibrate stage left, where the lifting has a phase."""
        known = self.store.holds("calibration", "calibration.json")
        return PhaseCalibration.load(self.store.path("calibration")) if known else None

    @cached_property
    def identified(self) -> IdentifiedModels:
        """What the identify stage left."""
        return IdentifiedModels.load_models(self.store.folder, self.population, self.facts)

    @cached_property
    def uncertain(self) -> UncertainModels:
        """What the quantify stage left."""
        return UncertainModels.load_sets(self.store.folder, self.identified)

    @cached_property
    def observers_record(self) -> Record:
        """What the synthesize stage left beside its observers: names, facts, and which is deployed."""
        return load_artifact(self.store.path("observers"), "observers")[0]

    @cached_property
    def deployed(self) -> Observer:
        """The deployed observer."""
        return Observer.load(self.store.path(*DEPLOYED))

    @cached_property
    def evaluation(self) -> Record:
        """What the evaluate stage left: errors of observers and baselines."""
        return load_artifact(self.store.path("evaluation"), "evaluation")[0]


@contextmanager
def open_finished(folder: Path, alone: bool = False) -> Iterator[Context]:
    """Open a run for reading while no other process writes there, and its files are as they were written."""
    load_run(folder)
    with locked(folder, shared=not alone):
        config, store = load_run(folder)
        store.verify()
        yield Context(config, store, Work())


@frozen
class StageStep:
    """One stage: what it does, the sections or ``section.key`` it follows from, and which studies have it."""

    stage: Stage
    run: Callable[[Context], None]
    sections: Names
    wanted: Callable[[StudyConfig], bool] = lambda config: True


def run_steps(context: Context, steps: Sequence[StageStep], until: Stage) -> None:
    """Run steps up to a stage; what later ones left goes where it does not follow from the study any more."""
    digests = stage_digests(context, steps)
    for step in steps[: [step.stage for step in steps].index(until) + 1]:
        if step.stage in digests:
            _run_step(context, step, digests)
    _outdate(context, digests)


def _run_step(context: Context, step: StageStep, digests: Mapping[Stage, str]) -> None:
    """Run a step, or find it done."""
    store, digest, progress = context.store, digests[step.stage], context.work.progress
    if (artefact := store.stored(digest)) is not None:
        known = store.manifest.get(step.stage)
        if known is None or known.digest != digest:
            _outdate(context, digests)
        store.add(step.stage, artefact)
        progress.finish(step.stage, artefact.seconds, skipped=True)
        return
    began = time.perf_counter()
    progress.start(step.stage, None)
    with store.drafting() as draft:
        results = Results(store.artefacts, code_key())
        step.run(replace(context, store=draft, work=replace(context.work, results=results)))
        seconds = time.perf_counter() - began
        _outdate(context, digests)
        store.path(METRICS).unlink(missing_ok=True)
        draft.commit(step.stage, digest, seconds, results.used)
    progress.finish(step.stage, seconds, skipped=False)


def _outdate(context: Context, digests: Mapping[Stage, str]) -> None:
    """Remove what does not follow from the study any more; the run folder is that of the study as it is now."""
    store, manifest = context.store, context.store.manifest
    outdated = [stage for stage in Stage if stage in manifest and manifest[stage].digest != digests.get(stage)]
    if outdated:
        store.path(METRICS).unlink(missing_ok=True)
        store.drop(*outdated)
    write_json(store.path(STUDY), context.config.dump())


def stage_digests(context: Context, steps: Sequence[StageStep]) -> dict[Stage, str]:
    """Return digests of what stages follow from: kros, the stages before, recordings, their part of the study."""
    tables, digest, digests = context.config.dump(), code_key(), {}
    tables |= {f"{section}.{key}": v for section, of in tables.items() if isinstance(of, dict) for key, v in of.items()}
    for step in steps:
        if step.wanted(context.config):
            inputs = inputs_digest(context) if step.stage is Stage.READ else ""
            digest = digest_of(digest, str(step.stage), inputs, [tables[name] for name in step.sections])
            digests[step.stage] = digest
    return digests


def inputs_digest(context: Context) -> str:
    """Return a digest of all recordings: files by path, size and time, arrays by their content."""
    given, source = context.given, context.config.data.source
    if given is not None:
        declared = (given.columns, given.sample_period_s, given.units, sorted(given.metadata.items()))
        return digest_of(declared, [(str(key), _digest(given, key)) for key in given.episodes])
    return digest_of([(str(f), *stamp_of(f)) for f in sorted(source.rglob("*")) if f.is_file()])


def _digest(given: Population, key: EpisodeKey) -> str:
    """Return a digest of an episode; of one that is not finite, the message: it is dropped, or an error."""
    try:
        return episode_digest(given.source(key))
    except NonFiniteError as error:
        return str(error)
