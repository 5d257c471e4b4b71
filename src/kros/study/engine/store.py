"""The run folder: a manifest of artefacts, which are in its store; their files are in the run folder too.

    <run>/manifest.json          which artefact every stage has, with digests of all files
    <run>/store/<digest>/        artefacts, and results of single units; see `core.store`
    <run>/models/ ...            the files of the artefacts, for people and for all that reads a run
    <run>/<stage>/<name>/        a run that a stage made, with another manifest and the same store

A stage writes a draft, which becomes an artefact, which the manifest names. So an interrupted stage leaves nothing that
counts, and nothing is removed from the run folder that the manifest does not list with the content it has.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from ...core.artifacts import json_bytes
from ...core.errors import DataError
from ...core.files import TEMPORARY, is_file, write_bytes
from ...core.locks import NAME as LOCK
from ...core.store import (
    MANIFEST,
    Artefact,
    ArtefactStore,
    Described,
    describe,
    digest_of,
    file_digest,
    place,
    read_manifest,
    recorded_files,
    remove,
    write_manifest,
)

log = logging.getLogger(__name__)

STORE, OWN = "store", "run"


@dataclass(frozen=True)
class Store:
    """A run folder; `place` is the draft of the stage that runs, `shared` the store of the run around this one."""

    folder: Path
    place: Path | None = None
    shared: Path | None = None

    @property
    def artefacts(self) -> ArtefactStore:
        """What was computed, for this run or another one that shares its store."""
        return ArtefactStore(self.shared or self.folder / STORE)

    @property
    def manifest(self) -> dict[str, Artefact]:
        """The artefacts of this run by stage; a manifest that cannot be believed is logged, and as good as none."""
        try:
            return read_manifest(self.folder)
        except DataError as error:
            log.warning("%s", error)
            return {}

    @property
    def digest(self) -> str:
        """A digest of all stages of this run."""
        return digest_of(sorted((str(stage), artefact.digest) for stage, artefact in self.manifest.items()))

    def path(self, *parts: str) -> Path:
        """Return where something that earlier stages wrote is read from."""
        return self.folder.joinpath(*parts)

    def draft(self, *parts: str) -> Path:
        """Return where the running stage writes something; it will be found at `path` once the stage is done."""
        return (self.place or self.folder).joinpath(*parts)

    def nested(self, stage: str, name: str) -> Store:
        """Return the run folder of a study that a stage makes inside this one."""
        return Store(self.path(stage, name), shared=self.artefacts.folder)

    def runs(self, stage: str = "*") -> list[Store]:
        """Return the runs in the folder of a stage, or all."""
        inside = sorted(path.parent for path in self.folder.glob(f"{stage}/*/{MANIFEST}"))
        return [self.nested(*folder.parts[-2:]) for folder in inside if not folder.is_symlink()]

    def record(self, stage: str) -> Artefact | None:
        """Return the artefact of a finished stage, or None."""
        return self.manifest.get(stage)

    def files(self) -> frozenset[str]:
        """Return the names of all files that belong to the run."""
        return recorded_files(self.folder)

    def holds(self, *parts: str) -> bool:
        """Tell whether a file, or any file in a folder, belongs to the run."""
        name = "/".join(parts)
        return any(f == name or f.startswith(f"{name}/") for f in self.files())

    def verify(self, *stages: str) -> None:
        """Make sure that what finished stages wrote is as they left it, and the study and its metrics too."""
        manifest = read_manifest(self.folder)
        for stage in (*stages, OWN) if stages else manifest:
            if stage in manifest:
                self._verify(stage, manifest[stage])

    def _verify(self, stage: str, artefact: Artefact) -> None:
        for name in (name for name in artefact.files if not artefact.matches(self.folder, name)):
            reason = "was changed or damaged since" if self.path(name).exists() else "is missing"
            raise DataError(f"Run: {self.path(name)}, which stage {stage} wrote, {reason}; run the study again.")
        self._verify_runs(artefact)

    def _verify_runs(self, artefact: Artefact) -> None:
        for name, digest in artefact.runs.items():
            run = Store(place(self.folder, name))
            run.verify()
            if run.digest != digest:
                raise DataError(f"Run {run.folder}: is missing or another one; run the study again.")

    def stored(self, digest: str) -> Artefact | None:
        """Return an artefact that is in the store, whole, as are the runs that were made with it."""
        artefact = self.artefacts.load(digest)
        try:
            self._verify_runs(artefact or Artefact(digest=""))
        except DataError:
            return None
        return artefact

    @contextmanager
    def drafting(self) -> Iterator[Store]:
        """Give a store whose drafts are elsewhere until `commit`; what is not committed goes."""
        with self.artefacts.draft() as draft:
            yield replace(self, place=draft)

    def commit(self, stage: str, digest: str, seconds: float, results: Collection[str] = ()) -> None:
        """Make an artefact of the draft of the running stage, and add it."""
        draft, runs = self.draft(), {f"{stage}/{run.folder.name}": run.digest for run in self.runs(stage)}
        draft.mkdir(exist_ok=True)
        paths = sorted(path for path in draft.rglob("*") if is_file(path))
        files = {path.relative_to(draft).as_posix(): describe(path) for path in paths}
        artefact = Artefact(digest=digest, seconds=seconds, files=files, runs=runs, results=tuple(sorted(results)))
        self.artefacts.put(draft, artefact)
        self.add(stage, artefact)

    def add(self, stage: str, artefact: Artefact) -> None:
        """Name an artefact of the store in the manifest, in place of an earlier one, and put its files into place."""
        entry, earlier = artefact.model_copy(update={"results": ()}), self.record(stage)
        if earlier != entry:
            if earlier is not None and earlier.digest != entry.digest:
                self.drop(stage)
            write_manifest(self.folder, self.manifest | {stage: entry})
        for name in artefact.files:
            self.artefacts.link(artefact, name, self.folder)

    def drop(self, *stages: str) -> None:
        """Forget stages and their files in the run folder that are as written; artefacts and runs inside stay."""
        manifest = self.manifest
        for stage in stages:
            artefact = manifest.pop(stage, Artefact(digest=""))
            for name in artefact.files:
                if artefact.matches(self.folder, name):
                    self.path(name).unlink()
                    _prune(self.path(name).parent, self.folder)
                else:
                    log.info("%s: is not as kros wrote it, and stays", self.path(name))
        write_manifest(self.folder, manifest)

    def remove(self) -> None:
        """Remove a run as far as its manifest lists it, and its folder where nothing else is in it."""
        for run in self.runs():
            run.remove()
        self.drop(*self.manifest)
        self.path(MANIFEST).unlink(missing_ok=True)
        if self.shared is None:
            self.artefacts.sweep(())
            _prune(self.artefacts.folder, self.folder)
        _prune(self.folder, self.folder.parent)

    def tidy(self) -> None:
        """Remove what a killed process left half done."""
        for folder in (self.folder, self.artefacts.folder):
            for path in folder.glob(f"{TEMPORARY}*"):
                if path.name != LOCK:
                    remove(path)

    def sweep(self) -> None:
        """Remove what the run does not use any more from its store."""
        self.artefacts.sweep(self._named())

    def _named(self) -> set[str]:
        """Digests of all artefacts of this run and of those inside, and of results that they were computed from."""
        stored = [self.artefacts.load(artefact.digest) for artefact in self.manifest.values()]
        named = {digest for artefact in stored if artefact for digest in (artefact.digest, *artefact.results)}
        return named.union(*(run._named() for run in self.runs()))

    def keep(self, name: str, content: Any) -> None:
        """Write a file of the run that is of no stage as JSON, where it is not there already."""
        text, free = json_bytes(content), self.record(OWN) or Artefact(digest="")
        if self.is_kept(name) and free.files[name][0] == sha256(text).hexdigest():
            return
        write_bytes(place(self.folder, name), text)
        self._write_own(free.files | {name: describe(self.path(name))})

    def is_kept(self, name: str) -> bool:
        """Tell whether a file of the run that is of no stage is there as it was written."""
        free = self.record(OWN)
        return free is not None and name in free.files and free.matches(self.folder, name)

    def discard(self, name: str) -> None:
        """Remove a file of the run that is of no stage."""
        free = self.record(OWN)
        if free is not None and name in free.files:
            self._write_own({n: about for n, about in free.files.items() if n != name})
        place(self.folder, name).unlink(missing_ok=True)

    def _write_own(self, files: dict[str, Described]) -> None:
        write_manifest(self.folder, self.manifest | {OWN: Artefact(digest="", files=files)})


def _prune(folder: Path, root: Path) -> None:
    """Remove folders that have become empty, up to a root."""
    with suppress(OSError):
        while folder != root:
            folder.rmdir()
            folder = folder.parent


@cache
def code_key() -> str:
    """Return a digest of all files of kros: Python, C, templates and scripts."""
    root = Path(__file__).resolve().parents[2]
    files = sorted(f for f in root.rglob("*") if f.is_file() and "__pycache__" not in f.parts)
    return digest_of([(str(f.relative_to(root)), file_digest(f)) for f in files])
