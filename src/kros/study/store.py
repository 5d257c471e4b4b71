"""The run folder: stages leave artifacts and a record; a stage whose record still fits is skipped.

A record holds the key of the stage (a hash of its configuration, of its inputs and of kros's own source), the seconds it took, and
the content hash of every file it wrote. Deleting or changing an artifact makes its stage run again.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from ..core.artifacts import plain, read_json, write_json
from ..core.errors import DataError
from .config import Stage

_BLOCK = 1 << 20
_LARGE = 8 << 20  # recordings: identified by name, size and time instead of content


@dataclass(frozen=True)
class Store:
    """A run folder and the records of its stages."""

    folder: Path

    def path(self, *parts: str) -> Path:
        """Return a path inside the run folder."""
        return self.folder.joinpath(*parts)

    def record(self, stage: Stage) -> dict[str, Any] | None:
        """Return the record of a finished stage, or None."""
        path = self.path("stages", f"{stage.value}.json")
        return read_json(path) if path.exists() else None

    def is_current(self, stage: Stage, key: str) -> bool:
        """Tell whether a stage was finished with this key and its files are as it left them."""
        record = self.record(stage)
        if record is None or record["key"] != key:
            return False
        return all(self.path(name).exists() and fingerprint(self.path(name)) == digest for name, digest in record["files"].items())

    def verify(self, *stages: Stage) -> None:
        """Make sure that what finished stages wrote is as they left it; all stages where none is named.

        Raises
        ------
        DataError
            When a file is gone or has changed, by name.
        """
        for stage in stages or tuple(Stage):
            record = self.record(stage)
            for name, digest in record["files"].items() if record is not None else ():
                if not self.path(name).is_file() or fingerprint(self.path(name)) != digest:
                    found = "was changed or damaged since" if self.path(name).is_file() else "is missing"
                    raise DataError(f"Run {self.folder}: {name}, which {stage.value} wrote, {found}; run the study again.")

    def clear(self, stage: Stage) -> None:
        """Forget a stage: its record first, then the files it wrote."""
        record = self.record(stage)
        if record is None:
            return
        self.path("stages", f"{stage.value}.json").unlink()
        for name in record["files"]:
            self.path(name).unlink(missing_ok=True)

    def finish(self, stage: Stage, key: str, seconds: float, files: list[Path]) -> None:
        """Record a finished stage."""
        digests = {str(f.relative_to(self.folder)): fingerprint(f) for f in sorted(files)}
        write_json(
            self.path("stages", f"{stage.value}.json"), {"schema": 1, "stage": stage, "key": key, "seconds": seconds, "files": digests}
        )

    def output_key(self, stage: Stage) -> str:
        """Return a hash of everything a finished stage wrote."""
        record = self.record(stage)
        return hash_of(record["files"]) if record else ""


def hash_of(content: Any) -> str:
    """Return a hash of anything that turns into JSON."""
    return hashlib.sha256(json.dumps(plain(content), sort_keys=True).encode()).hexdigest()


def fingerprint(path: Path) -> str:
    """Return a file's content hash; for a large recording its size and time."""
    status = path.stat()
    if status.st_size > _LARGE:
        return f"{status.st_size}:{status.st_mtime_ns}"
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def source_key(source: Path) -> str:
    """Return a hash of all recordings below a folder: path, size and time."""
    files = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
    return hash_of([[str(f), f.stat().st_size, f.stat().st_mtime_ns] for f in files])


@cache
def code_key() -> str:
    """Return a hash of kros's own source."""
    root = Path(__file__).resolve().parents[1]
    files = sorted(f for pattern in ("*.py", "*.jinja", "*.html", "*.css", "*.json") for f in root.rglob(pattern))
    return hash_of([[str(f.relative_to(root)), fingerprint(f)] for f in files])


def remove_tree(folder: Path) -> None:
    """Remove a folder of our own making."""
    if folder.exists():
        shutil.rmtree(folder)
