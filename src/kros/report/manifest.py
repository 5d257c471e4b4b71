"""The manifest of a run folder, and artefacts: what a stage wrote, named by the digest of all that it follows from.

    <run>/store/<digest>/        what a stage wrote, and `artefact.json`, which lists it
    <run>/store/<digest>.npz     the result of one task of a map; see `core.work`
    <run>/manifest.json          the artefacts of a run; their files are at their places in the run folder too

A digest is of settings, inputs and source, so what is there need not be computed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated

from pydantic import Field, NonNegativeFloat

from ..core import DataError, Names, Storable, frozen, is_file, stamp_of
from ..core.artifacts import file_digest

MANIFEST = "manifest.json"
Described = tuple[str, int, int]  # SHA-256, size in bytes, time of the last change in ns


@dataclass(frozen=True)
class Artefact(Storable):
    """Files that follow from what `digest` is of."""

    KIND = "artefact"
    digest: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    seconds: NonNegativeFloat = 0.0  # that it took
    files: dict[str, Described] = field(default_factory=dict)  # by name
    results: Names = ()  # digests of the results that it was computed from

    def matches(self, folder: Path, name: str) -> bool:
        """Return whether a file is in a folder as it was written; one with its size and time is not read."""
        path, (content, *stamp) = place(folder, name), self.files[name]
        return is_file(path) and (stamp_of(path) == tuple(stamp) or file_digest(path) == content)


@frozen
class Manifest(Storable):
    """The artefacts of a run by stage; what they were computed from stands in the store."""

    KIND = "manifest"
    artefacts: dict[str, Artefact]


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
            raise DataError(f"Run folder {folder}: {path} is a link; put a folder in its place.")
    return folder / name


def read_manifest(folder: Path) -> dict[str, Artefact]:
    """Return the artefacts of a run by stage; none where there is no manifest."""
    return Manifest.load(folder).artefacts if is_file(folder / MANIFEST) else {}


def write_manifest(folder: Path, artefacts: Mapping[str, Artefact]) -> None:
    """Write which artefacts a run has."""
    Manifest({stage: replace(artefact, results=()) for stage, artefact in artefacts.items()}).save(folder)


def recorded_files(folder: Path) -> frozenset[str]:
    """Return the names of all files that belong to a run."""
    return frozenset().union(*(artefact.files for artefact in read_manifest(folder).values()))
