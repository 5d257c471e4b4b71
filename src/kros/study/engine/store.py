"""The run folder: a manifest of artefacts, which are in its store; their files are in the run folder too.

    <run>/manifest.json          which artefact every stage has, with digests of all files
    <run>/store/<digest>/        artefacts, and results of single units; see `report.manifest`
    <run>/models/ ...            the files of the artefacts, for people and for all that reads a run
    <run>/<stage>/<name>/        a run that a stage made, among its files, with another manifest and the same store

A stage writes a draft, which becomes an artefact, which the manifest names. So an interrupted stage leaves nothing that
counts, and nothing is removed from the run folder that the manifest does not list with the content it has.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from hashlib import sha256
from pathlib import Path

from ...core import ConfigError, DataError, DimensionError, Record, frozen
from ...core.artifacts import as_written, digest_of, file_digest, read_json, write_json
from ...core.files import TEMPORARY, draft_beside, is_file, link_or_copy
from ...report.manifest import MANIFEST, Artefact, describe, place, read_manifest, recorded_files, write_manifest
from ..config import Stage, StudyConfig, stored_config
from .lock import NAME as LOCK
from .lock import locked

log = logging.getLogger(__name__)

STORE = "store"
DEPLOYED = ("observers", "deployed.json")
STUDY, METRICS = "study.json", "metrics.json"  # of a run, and of no stage


@frozen
class Store:
    """A run folder; `place` is the draft of the stage that runs, `shared` the store of the run around this one."""

    folder: Path
    place: Path | None = None
    shared: Path | None = None

    @property
    def artefacts(self) -> Path:
        """The folder of what was computed, for this run or another one that shares its store."""
        return self.shared or self.folder / STORE

    @property
    def manifest(self) -> dict[str, Artefact]:
        """The artefacts of this run by stage; a manifest that cannot be believed is logged, and as good as none."""
        try:
            return read_manifest(self.folder)
        except DataError as error:
            log.warning("%s", error)
            return {}

    def path(self, *parts: str) -> Path:
        """Return where something that earlier stages wrote is read from."""
        return self.folder.joinpath(*parts)

    def draft(self, *parts: str) -> Path:
        """Return where the running stage writes something; it will be found at `path` once the stage is done."""
        return (self.place or self.folder).joinpath(*parts)

    def nested(self, *parts: str) -> Store:
        """Return the run folder of a study that the running stage makes in its draft."""
        return Store(self.draft(*parts), shared=self.artefacts)

    def files(self) -> frozenset[str]:
        """Return the names of all files that belong to the run."""
        return recorded_files(self.folder)

    def holds(self, *parts: str) -> bool:
        """Tell whether a file belongs to the run."""
        return "/".join(parts) in self.files()

    def metrics(self) -> Record:
        """Return the metrics of the run."""
        content = read_json(self.path(METRICS))
        if not isinstance(content, dict) or not {"study", "units"} <= set(content):
            raise DataError(f"Run: {self.path(METRICS)} holds no metrics; run the study again.")
        return content

    def verify(self) -> None:
        """Make sure that what finished stages wrote is as they left it, but for the report, which is written again."""
        for stage, artefact in read_manifest(self.folder).items():
            for name in artefact.files if stage != Stage.REPORT else ():
                if not artefact.matches(self.folder, name):
                    problem = f"{self.path(name)} of stage {stage} is missing, or was changed since"
                    raise DataError(f"Run: {problem}; run the study again.")

    def stored(self, digest: str) -> Artefact | None:
        """Return an artefact that is in the store, whole."""
        folder = self.artefacts / digest
        try:
            artefact = Artefact.load(folder)
            whole = artefact.digest == digest and all(artefact.matches(folder, name) for name in artefact.files)
        except DataError:
            return None
        return artefact if whole else None

    @contextmanager
    def drafting(self) -> Iterator[Store]:
        """Give a store whose drafts are elsewhere until `commit`; what is not committed goes."""
        with draft_beside(self.artefacts) as draft:
            yield replace(self, place=draft)

    def commit(self, stage: str, digest: str, seconds: float, results: Collection[str] = ()) -> None:
        """Move the draft of the running stage into the store, in place of one that is not whole, and name it."""
        draft = self.draft()
        draft.mkdir(exist_ok=True)
        files = {
            path.relative_to(draft).as_posix(): describe(path) for path in sorted(draft.rglob("*")) if is_file(path)
        }
        artefact = Artefact(digest, seconds, files, tuple(sorted(results)))
        artefact.save(draft)
        target = self.artefacts / digest
        if target.exists():
            target.replace(draft.with_name("earlier"))
        draft.replace(target)
        self.add(stage, artefact)

    def add(self, stage: str, artefact: Artefact) -> None:
        """Name an artefact of the store in the manifest, in place of an earlier one, and put its files into place."""
        if self.manifest.get(stage) != replace(artefact, results=()):
            self.drop(stage)
            write_manifest(self.folder, self.manifest | {stage: artefact})
        beside = self.artefacts / f"{TEMPORARY}link"
        for name in (name for name in artefact.files if not artefact.matches(self.folder, name)):
            target = place(self.folder, name)
            try:  # the same file where the file system can, else a copy
                target.parent.mkdir(parents=True, exist_ok=True)
                link_or_copy(self.artefacts / artefact.digest / name, beside)
                beside.replace(target)
            except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
                blocking = error.filename2 or error.filename
                raise ConfigError(f"Run folder: {blocking} is in the place of a result; move it away.") from error

    def drop(self, *stages: str) -> None:
        """Forget stages and their files in the run folder that are as written; artefacts stay."""
        manifest = self.manifest
        for artefact in [manifest.pop(stage) for stage in stages if stage in manifest]:
            for name in artefact.files:
                if artefact.matches(self.folder, name):
                    self.path(name).unlink()
                    with suppress(OSError):  # folders that have become empty; the run's own holds the manifest
                        os.removedirs(self.path(name).parent)
                else:
                    log.info("%s: is not as kros wrote it, and stays", self.path(name))
        write_manifest(self.folder, manifest)

    def remove(self) -> None:
        """Remove a run that began in a new or empty folder."""
        self.drop(*self.manifest)
        for name in (MANIFEST, STUDY, STORE):
            _remove(self.path(name))

    def tidy(self) -> None:
        """Remove what a killed process left half done."""
        for path in (*self.folder.glob(f"{TEMPORARY}*"), *self.artefacts.glob(f"{TEMPORARY}*")):
            if path.name != LOCK:
                _remove(path)

    def sweep(self) -> None:
        """Remove from the store what neither this run nor one inside, or an artefact of theirs, follows from."""
        inside = [replace(self, folder=path.parent) for path in self.folder.glob(f"*/*/{MANIFEST}")]
        digests = {artefact.digest for run in (self, *inside) for artefact in run.manifest.values()}
        stored = [artefact for artefact in map(self.stored, digests) if artefact is not None]
        named = {digest for artefact in stored for digest in (artefact.digest, *artefact.results)}
        for path in self.artefacts.iterdir():
            if len(path.stem) == 2 * sha256().digest_size and path.stem not in named:
                _remove(path)


def _remove(path: Path) -> None:
    """Remove a file or a folder."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@cache
def code_key() -> str:
    """Return a digest of all files of kros: Python, C, templates and scripts."""
    root = Path(__file__).resolve().parents[2]
    files = sorted(f for f in root.rglob("*") if f.is_file() and "__pycache__" not in f.parts)
    return digest_of([(str(f.relative_to(root)), file_digest(f)) for f in files])


def require_own(out: Path, config: StudyConfig) -> bool:
    """Refuse a folder of another study, by name and recordings; return whether the folder is new or empty."""
    if out.exists() and not out.is_dir():
        raise ConfigError(f"Output {out}: is a file; name a folder.")
    if not out.exists() or all(path.name.startswith(TEMPORARY) for path in out.iterdir()):
        return True
    if not (out / STUDY).exists():
        raise ConfigError(f"Output {out}: is a folder with other content; name a new folder or an earlier run.")
    with as_written("study", out / STUDY):
        study = read_json(out / STUDY)
        there, this = (study["name"], study["data"]["source"]), (config.name, str(config.data.source))
    if there != this:
        both = f"holds the study {there[0]!r} of {there[1]}, and this is {this[0]!r} of {this[1]}"
        raise ConfigError(f"Output {out}: {both}; name another folder, or remove this one if it is not needed.")
    return False


@contextmanager
def open_run(out: Path, config: StudyConfig) -> Iterator[Store]:
    """Open a study's run folder for this process alone; what an interrupted run left half done goes."""
    above = [p for p in (out, *out.absolute().parents) if not p.exists()]
    out.mkdir(parents=True, exist_ok=True)
    try:
        with locked(out):
            fresh, store = require_own(out, config), Store(out)
            store.tidy()
            try:
                if fresh:
                    write_json(store.path(STUDY), config.dump())
                yield store
            except (ConfigError, DataError, DimensionError):
                if fresh and Stage.READ not in store.manifest:
                    store.remove()
                raise
    finally:
        with suppress(OSError):  # it is not empty, as a rule
            for folder in above:
                folder.rmdir()


def load_run(folder: Path) -> tuple[StudyConfig, Store]:
    """Read the study of a run folder."""
    path = folder / STUDY
    if not path.exists():
        raise ConfigError(f"Run {folder}: there is no {STUDY} in it; name the folder that kros run or kros demo wrote.")
    return stored_config(read_json(path), path), Store(folder)
