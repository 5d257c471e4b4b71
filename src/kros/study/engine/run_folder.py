"""Run folders opened: to run a study in, which is that study's alone, or to read what a finished one left."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ...core.artifacts import read_json, write_json
from ...core.errors import ConfigError, DataError, DimensionError
from ...core.files import TEMPORARY
from ...core.locks import locked
from ..config import Stage, StudyConfig, stored_config
from .store import STUDY, Store


def require_own(out: Path, config: StudyConfig) -> bool:
    """Refuse a folder of another study, by name and recordings; return whether the folder is new or empty."""
    if out.exists() and not out.is_dir():
        raise ConfigError(f"Output {out}: is a file; name a folder.")
    if not out.exists() or all(path.name.startswith(TEMPORARY) for path in out.iterdir()):
        return True
    if not (out / STUDY).exists():
        raise ConfigError(f"Output {out}: is a folder with other content; name a new folder or an earlier run.")
    there, this = _identity(_read_study(out)), _identity(config.dump())
    if there != this:
        both = f"holds the study {there[0]!r} of {there[1]}, and this is {this[0]!r} of {this[1]}"
        raise ConfigError(f"Output {out}: {both}; name another folder, or remove this one if it is not needed.")
    return False


def _identity(study: dict[str, Any]) -> tuple[str, str]:
    """Return a study's name and where its recordings are: what makes a changed study the same study still."""
    data = study.get("data")
    return str(study.get("name")), str(Path(str(data.get("source"))).resolve()) if isinstance(data, dict) else "nowhere"


def _read_study(folder: Path) -> dict[str, Any]:
    try:
        content = read_json(folder / STUDY)
    except DataError as error:
        raise ConfigError(f"Run {folder}: its {STUDY} cannot be read ({error}); name another folder.") from error
    if not isinstance(content, dict):
        raise ConfigError(f"Run {folder}: its {STUDY} holds no study; name another folder.")
    return content


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
                if fresh and store.record(Stage.READ) is None:
                    store.remove()
                raise
    finally:
        with suppress(OSError):  # it is not empty, as a rule
            for folder in above:
                folder.rmdir()


@contextmanager
def open_finished(folder: Path, *stages: Stage, alone: bool = False) -> Iterator[tuple[StudyConfig, Store]]:
    """Open a run for reading while no other process writes there; the files of some stages are as they were written."""
    folder = Path(folder)
    load_run(folder)
    with locked(folder, shared=not alone):
        config, store = load_run(folder)
        store.verify(*stages)
        yield config, store


def load_run(folder: Path) -> tuple[StudyConfig, Store]:
    """Read the study of a run folder."""
    folder = Path(folder)
    if not (folder / STUDY).exists():
        raise ConfigError(f"Run {folder}: there is no {STUDY} in it; name the folder that kros run or kros demo wrote.")
    return stored_config(_read_study(folder), folder / STUDY), Store(folder)
