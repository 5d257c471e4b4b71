"""The run folder: stages leave artifacts and a record; a stage whose record still fits is skipped.

A stage writes into a draft inside the run folder, and what is in the draft when it ends is what it wrote: that is recorded, with content
hashes, and then moved into place. So a record is complete however a stage writes, an interrupted stage leaves nothing but its draft, and
nothing is ever removed that a record does not list with the content it has.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

from ...core import records
from ...core.artifacts import plain, write_json
from ...core.errors import ConfigError, DataError
from ...core.locks import NAME as LOCK
from ...core.records import OWN, Record
from .seen import KnownResults

log = logging.getLogger(__name__)

PARTIAL = ".kros.partial"
SEEN = "seen"
BOOKKEEPING = frozenset({PARTIAL, LOCK})
"""What a process that works in a run folder keeps there meanwhile, and a killed one leaves."""


@dataclass(frozen=True)
class Store:
    """A run folder and the records of its stages."""

    folder: Path
    place: Path | None = None
    _runs: list[str] = field(default_factory=list, compare=False, repr=False)
    _told: dict[Path, tuple[str, str]] = field(default_factory=dict, compare=False, repr=False)

    def path(self, *parts: str) -> Path:
        """Return where something that earlier stages wrote is read from."""
        return self.folder.joinpath(*parts)

    def draft(self, *parts: str) -> Path:
        """Return where the running stage writes something; it will be found at `path` once the stage is done."""
        return (self.place or self.folder).joinpath(*parts)

    def told(self, path: Path, digest: str) -> None:
        """Take the digest of a drafted file from who wrote it; it is believed while the file's size and time stay."""
        self._told[path] = records.stamp(path), digest

    def nested(self, stage: str, name: str) -> Store:
        """Return the run folder of a study that the running stage makes inside this one; it keeps its own records, and is not drafted."""
        self._runs.append(f"{_name(stage)}/{name}")
        return Store(self.path(_name(stage), name))

    def runs(self, stage: str) -> list[Store]:
        """Return the runs inside that a stage made, which are in a folder of its name."""
        folder = self.path(stage)
        inside = sorted(folder.iterdir()) if folder.is_dir() and not folder.is_symlink() else []
        return [
            Store(f)
            for f in inside
            if f.is_dir() and not f.is_symlink() and ((f / records.FOLDER).is_dir() or (f / PARTIAL).is_dir())
        ]

    @contextmanager
    def drafting(self) -> Iterator[Store]:
        """Give a store whose drafts are elsewhere until `commit`; what is not committed goes."""
        self.tidy()
        try:
            yield replace(self, place=self.path(PARTIAL, "draft"), _runs=[], _told={})
        finally:
            self.tidy()

    def tidy(self) -> None:
        """Remove the draft of an interrupted stage."""
        partial = self.path(PARTIAL)
        if partial.is_symlink():
            partial.unlink()
        elif partial.exists():
            shutil.rmtree(partial)

    def record(self, stage: str) -> Record | None:
        """Return the record of a finished stage, or None; one that cannot be believed is logged, and as good as none."""
        try:
            return records.read_record(self.folder, _name(stage))
        except DataError as error:
            log.warning("%s", error)
            return None

    def is_current(self, stage: str, key: str) -> bool:
        """Tell whether a stage was finished with this key and its files are as it left them."""
        record = self.record(stage)
        return (
            record is not None and record.key == key and all(record.matches(self.folder, name) for name in record.files)
        )

    def files(self) -> frozenset[str]:
        """Return the names of all files that belong to the run."""
        return records.recorded_files(self.folder)

    def holds(self, *parts: str) -> bool:
        """Tell whether a file, or any file in a folder, belongs to the run."""
        name = "/".join(parts)
        return any(f == name or f.startswith(f"{name}/") for f in self.files())

    def verify(self, *stages: str) -> None:
        """Make sure that what finished stages wrote is as they left it, and the study and its metrics too."""
        for stage in (
            (*map(_name, stages), OWN) if stages else [r.stage for r in records.records(self.folder) if r.stage != SEEN]
        ):
            record = records.read_record(self.folder, stage)
            for name in record.all if record is not None else ():
                if record is not None and not record.matches(self.folder, name):
                    found = "was changed or damaged since" if self.path(name).exists() else "is missing"
                    raise DataError(
                        f"Run {self.folder}: {name}, which stage {stage} wrote, {found}; run the study again."
                    )

    def commit(self, stage: str, key: str, seconds: float) -> None:
        """Record what the running stage wrote, then move it into place."""
        draft = self.draft()
        written = sorted(f.relative_to(draft).as_posix() for f in draft.rglob("*") if records.is_file(f))
        for name in written:
            self._require_free(name)
        digests = {name: self._digest(draft / name) for name in written}
        stamps = {name: records.stamp(draft / name) for name in written if records.is_large(draft / name)}
        for run in self._runs:
            known = Store(self.path(run)).everything()
            digests |= {f"{run}/{name}": records.digest(self.path(run, name)) for name in known}
        self._write(Record(_name(stage), key, seconds, dict(sorted(digests.items())), stamps, tuple(self._runs)))
        for name in written:
            target = self.path(name)
            target.parent.mkdir(parents=True, exist_ok=True)
            (draft / name).replace(target)

    def _digest(self, path: Path) -> str:
        stamp, digest = self._told.get(path, ("", ""))
        return digest if stamp == records.stamp(path) else records.digest(path)

    def _require_free(self, name: str) -> None:
        target = records.place(self.folder, name)
        above = [p for p in target.parents if p.is_relative_to(self.folder) and p.exists() and not p.is_dir()]
        if above or (target.is_dir() and not target.is_symlink()):
            raise ConfigError(
                f"Run folder {self.folder}: {(above or [target])[0]} is in the place of a result ({name}); move it away."
            )

    def clear(self, stage: str) -> None:
        """Forget a stage: the files it wrote, where they are as it left them, then its record; runs inside stay, to be resumed."""
        record = self.record(stage)
        for name in record.all if record is not None else ():
            if record is not None and not any(name.startswith(f"{run}/") for run in record.runs):
                self._remove(record, name)
        self._unlink(records.record_path(self.folder, _name(stage)))

    def erase(self, stage: str) -> None:
        """Forget a stage with the runs inside, finished or not."""
        for run in self.runs(_name(stage)):
            run.remove()
        self.clear(stage)

    def remove(self) -> None:
        """Remove a run as far as its records know it, and its folder where nothing else is in it."""
        for record in records.records(self.folder):
            self.erase(record.stage)
        self.tidy()
        _prune(self.folder, self.folder.parent)

    def _remove(self, record: Record, name: str) -> None:
        if record.matches(self.folder, name):
            self._unlink(self.path(name))
        else:
            log.info("%s: is not as stage %s left it, and stays", self.path(name), record.stage)

    def _unlink(self, path: Path) -> None:
        path.unlink(missing_ok=True)
        _prune(path.parent, self.folder)

    def everything(self) -> list[str]:
        """Return the names of all files of the run, records among them."""
        return sorted(self.files() | {f"{records.FOLDER}/{r.stage}.json" for r in records.records(self.folder)})

    def keep(self, name: str, content: Any) -> None:
        """Write a file of the run's own as JSON, where its content is not there already."""
        write_json(self.path(PARTIAL, "own"), content)
        found = records.digest(self.path(PARTIAL, "own"))
        own = self._own()
        if own.get(name) != found or not self.is_kept(name):
            self._write(Record(OWN, own=own | {name: found}))
            self.path(PARTIAL, "own").replace(records.place(self.folder, name))

    def is_kept(self, name: str) -> bool:
        """Tell whether a file of the run's own is there as it was written."""
        record = self.record(OWN)
        return record is not None and name in record.own and record.matches(self.folder, name)

    def discard(self, name: str) -> None:
        """Remove a file of the run's own."""
        own = self._own()
        if own.pop(name, None) is not None:
            self._write(Record(OWN, own=own))
        records.place(self.folder, name).unlink(missing_ok=True)

    def seen(self, key: str) -> KnownResults:
        """Return what stages of earlier runs computed unit by unit, with the same code by its key; it is of no stage, and stays when they go."""

        def note(path: Path) -> None:
            record = self.record(SEEN)
            files = dict(record.files) if record is not None else {}
            self._write(
                Record(SEEN, files=dict(sorted((files | {f"{SEEN}/{path.name}": records.digest(path)}).items())))
            )

        return KnownResults(self.path(SEEN), key, note)

    def _own(self) -> dict[str, str]:
        record = self.record(OWN)
        return dict(record.own) if record is not None else {}

    def _write(self, record: Record) -> None:
        """Write a record whole or not at all, without temporary files beside it."""
        write_json(self.path(PARTIAL, "record"), record.content())
        path = records.record_path(self.folder, record.stage)
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path(PARTIAL, "record").replace(path)

    def output_key(self, stage: str) -> str:
        """Return a hash of everything a finished stage wrote."""
        record = self.record(stage)
        return hash_of(record.files) if record else ""


def _name(stage: str) -> str:
    return str(stage.value) if isinstance(stage, Enum) else stage


def _prune(folder: Path, root: Path) -> None:
    """Remove folders that have become empty, up to a root."""
    with suppress(OSError):
        while folder != root:
            folder.rmdir()
            folder = folder.parent


def hash_of(content: Any) -> str:
    """Return a hash of anything that turns into JSON."""
    return hashlib.sha256(json.dumps(plain(content), sort_keys=True).encode()).hexdigest()


def source_key(source: Path) -> str:
    """Return a hash of all recordings below a folder: path, size and time."""
    files = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
    return hash_of([[str(f), f.stat().st_size, f.stat().st_mtime_ns] for f in files])


@cache
def code_key() -> str:
    """Return a hash of all files of kros: Python, C, templates and scripts."""
    root = Path(__file__).resolve().parents[2]
    files = sorted(f for f in root.rglob("*") if f.is_file() and "__pycache__" not in f.parts)
    return hash_of([[str(f.relative_to(root)), records.digest(f)] for f in files])
