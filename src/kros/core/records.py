"""Records of a run folder: which files each stage wrote, and what was in them.

    <run>/stages/<stage>.json     one record a finished stage; `run.json` records the run's own files, which are of no stage

A record is believed as far as it can be checked: a name that leads out of the run folder, directly or through a link, makes it invalid.
Whoever reads a run asks here which files count; what no record lists is a leftover, or somebody else's.
"""

from __future__ import annotations

import hashlib
import logging
import math
import re
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from .artifacts import read_json
from .errors import DataError

log = logging.getLogger(__name__)

FOLDER, OWN = "stages", "run"
_PART = r"(?!\.\.?(?:/|\Z))[^/\\:\0]+"
_ORDINARY = re.compile(f"{_PART}(?:/{_PART})*")  # names that no system reads as anything else
_SCHEMA, _BLOCK = 1, 1 << 20
_LARGE = 8 << 20  # bytes; a larger file with the size and time that it was left with is not read again


@dataclass(frozen=True)
class Record:
    """What a stage left."""

    stage: str
    key: str = ""  # hash of all that the stage depends on
    seconds: float = 0.0  # time it took
    files: Mapping[str, str] = field(
        default_factory=dict
    )  # SHA-256 of every file, by its name relative to the run folder, with slashes
    stamps: Mapping[str, str] = field(default_factory=dict)  # size and time of large files
    runs: tuple[
        str, ...
    ] = ()  # folders that are runs of their own: their files are listed here too, and looked after there
    own: Mapping[str, str] = field(default_factory=dict)  # as `files`, for files of the run that are of no stage

    @property
    def all(self) -> dict[str, str]:
        """Digests of all files by name."""
        return {**self.files, **self.own}

    def content(self) -> dict[str, Any]:
        """Return what is written; parts that are empty are left out."""
        content: dict[str, Any] = {
            "schema": _SCHEMA,
            "stage": self.stage,
            "key": self.key,
            "seconds": self.seconds,
            "files": self.files,
        }
        return content | {name: part for name in ("stamps", "runs", "own") if (part := getattr(self, name))}

    def matches(self, folder: Path, name: str) -> bool:
        """Tell whether a file is there and as the stage left it."""
        path = place(folder, name)
        if not is_file(path):
            return False
        if name in self.stamps and stamp(path) == self.stamps[name]:
            return True
        return digest(path) == self.all[name]


def record_path(folder: Path, stage: str) -> Path:
    """Return where the record of a stage is."""
    return place(folder, f"{FOLDER}/{stage}.json")


def read_record(folder: Path, stage: str) -> Record | None:
    """Return the record of a finished stage, or None."""
    path = record_path(folder, stage)
    if not is_file(path):
        return None
    try:
        return _parsed(folder, stage, read_json(path))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(
            f"Record {path}: is damaged, or of another version of kros ({error}); run the study again."
        ) from error


def _parsed(folder: Path, stage: str, content: Any) -> Record:
    if (content["schema"], content["stage"]) != (_SCHEMA, stage):
        raise ValueError(
            f"schema and stage should be {(_SCHEMA, stage)}, found {(content['schema'], content['stage'])}"
        )
    seconds, runs = float(content["seconds"]), tuple(content.get("runs", ()))
    if not math.isfinite(seconds) or seconds < 0:
        raise ValueError(f"seconds should be a number of at least 0, found {seconds}")
    tables = [content["files"], content.get("stamps", {}), content.get("own", {})]
    texts = [content["key"], *runs, *(text for table in tables for pair in table.items() for text in pair)]
    if wrong := [text for text in texts if not isinstance(text, str)]:
        raise ValueError(f"{wrong[0]!r} should be a text")
    for above in dict.fromkeys(
        _parts(folder, name)[:-1] for name in (*content["files"], *runs, *content.get("own", {}))
    ):
        _folder(folder, above)
    return Record(stage, content["key"], seconds, tables[0], tables[1], runs, tables[2])


def place(folder: Path, name: str) -> Path:
    """Return the path of a file in a run folder."""
    parts = _parts(folder, name)
    return _folder(folder, parts[:-1]) / parts[-1]


def _parts(folder: Path, name: str) -> tuple[str, ...]:
    """The folders and the file of a name."""
    if _ORDINARY.fullmatch(name):
        return tuple(name.split("/"))
    parts, windows = PurePosixPath(name).parts, PureWindowsPath(name)
    if not parts or ".." in parts or "/".join(parts) != name or windows.anchor or "\0" in name:
        raise DataError(f"Run folder {folder}: {name!r} is not the name of a file inside it.")
    return parts


def _folder(folder: Path, parts: Sequence[str]) -> Path:
    """The folder below a run folder, none of which is a link."""
    path = folder
    for part in parts:
        path = path / part
        if path.is_symlink():
            raise DataError(
                f"Run folder {folder}: {path} is a link, and results stay inside the folder; put a folder in its place."
            )
    return path


def records(folder: Path) -> list[Record]:
    """Return all records of a run that can be believed; what cannot is logged."""
    found = []
    for stage in _stages(folder):
        try:
            record = read_record(folder, stage)
        except DataError as error:
            log.warning("%s", error)
            continue
        found += [record] if record is not None else []
    return found


def recorded_files(folder: Path) -> frozenset[str]:
    """Return the names of all files that belong to a run, without the records themselves."""
    if not _stages(folder):
        return frozenset(p.relative_to(folder).as_posix() for p in folder.rglob("*") if is_file(p))
    return frozenset(name for record in records(folder) for name in record.all)


def _stages(folder: Path) -> list[str]:
    where = folder / FOLDER
    return (
        sorted(p.stem for p in where.glob("*.json") if not p.name.startswith("."))
        if where.is_dir() and not where.is_symlink()
        else []
    )


def is_file(path: Path) -> bool:
    """Tell whether there is a regular file, not a link to one."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except (OSError, ValueError):
        return False


def is_large(path: Path) -> bool:
    """Tell whether a file takes long to read."""
    return path.stat().st_size > _LARGE


def stamp(path: Path) -> str:
    """Return a file's size and time."""
    status = path.stat()
    return f"{status.st_size}:{status.st_mtime_ns}"


def digest(path: Path) -> str:
    """Return a file's content hash."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            found.update(block)
    return found.hexdigest()
