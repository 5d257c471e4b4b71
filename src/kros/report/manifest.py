"""The manifest of a run folder, and artefacts: what a stage wrote, named by the digest of all that it follows from.

    <run>/store/<digest>/        what a stage wrote, and `artefact.json`, which lists it
    <run>/store/<digest>.npz     the result of one task of a map; see `core.work`
    <run>/manifest.json          the artefacts of a run; their files are at their places in the run folder too

A digest is of settings, inputs and source, so what is there need not be computed.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath

from pydantic import Field, NonNegativeFloat

from ..core import ConfigError, DataError, Names, Settings, is_file, stamp_of
from ..core.artifacts import CHECKSUM, check_checksum, file_digest, read_json, with_checksum, write_json

MANIFEST, INDEX = "manifest.json", "artefact.json"
Described = tuple[str, int, int]  # SHA-256, size in bytes, time of the last change in ns


class Artefact(Settings):
    """Files that follow from what `digest` is of."""

    digest: str = Field(pattern="^[0-9a-f]{64}$")
    seconds: NonNegativeFloat = 0.0  # that it took
    files: dict[str, Described] = Field(default_factory=dict)  # by name
    results: Names = ()  # digests of the results that it was computed from

    @classmethod
    def read(cls, path: Path) -> Artefact:
        """Read one that was written as JSON."""
        return cls.of(_checked(path), f"Artefact {path}")

    def matches(self, folder: Path, name: str) -> bool:
        """Return whether a file is in a folder as it was written; one with its size and time is not read."""
        path, (content, *stamp) = place(folder, name), self.files[name]
        return is_file(path) and (stamp_of(path) == tuple(stamp) or file_digest(path) == content)


def describe(path: Path) -> Described:
    """Return digest, size and time of a file."""
    return file_digest(path), *stamp_of(path)


def place(folder: Path, name: str) -> Path:
    """Return the path of a file in a folder; a name that leads out of it, directly or through a link, is refused."""
    parts = PurePosixPath(name).parts
    if not parts or ".." in parts or "/".join(parts) != name or PureWindowsPath(name).anchor or "\0" in name:
        raise DataError(f"Run folder {folder}: {name!r} is not the name of a file inside it.")
    for depth in range(1, len(parts)):
        path = folder.joinpath(*parts[:depth])
        if path.is_symlink():
            raise DataError(
                f"Run folder {folder}: {path} is a link, and results stay inside the folder; put a folder in its place."
            )
    return folder / name


def read_manifest(folder: Path) -> dict[str, Artefact]:
    """Return the artefacts of a run by stage; none where there is no manifest."""
    path = folder / MANIFEST
    if not is_file(path):
        return {}
    try:
        return {stage: Artefact.of(content, stage) for stage, content in _checked(path).items()}
    except (ConfigError, DataError, AttributeError, TypeError) as error:
        raise DataError(
            f"Manifest {path}: is damaged, or of another version of kros ({error}); run the study again."
        ) from error


def _checked(path: Path) -> Mapping[str, object]:
    content = read_json(path)
    check_checksum(content, path)
    return {key: value for key, value in content.items() if key != CHECKSUM}


def write_manifest(folder: Path, artefacts: Mapping[str, Artefact]) -> None:
    """Write which artefacts a run has; what they were computed from stands in the store."""
    write_json(folder / MANIFEST, with_checksum({s: a.model_dump(exclude={"results"}) for s, a in artefacts.items()}))


def recorded_files(folder: Path) -> frozenset[str]:
    """Return the names of all files that belong to a run."""
    return frozenset().union(*(artefact.files for artefact in read_manifest(folder).values()))
