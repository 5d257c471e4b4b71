"""A folder that appears whole or not at all, filled by threads."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from ...core.errors import DataError
from ...core.locks import locked

T = TypeVar("T")


def in_threads(work: Sequence[Callable[[], T]]) -> list[T]:
    """Do pieces of work in threads, one per processor; what has not begun when one fails is left."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        tasks = [pool.submit(piece) for piece in work]
        try:
            return [task.result() for task in tasks]
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def same_file(path: Path, target: Path) -> None:
    """Put a file in a second place: the same one where the file system can, else a copy."""
    try:
        os.link(path, target)
    except OSError:
        shutil.copyfile(path, target)


@contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """Give a folder beside `out` to fill; it is moved there at the end, or removed when anything fails."""
    out = out.absolute()
    work = out.with_name(f".{out.name}.kros")
    work.mkdir(parents=True, exist_ok=True)
    try:
        with locked(work):
            filled, aside = work / "new", work / "old"
            _tidy(out, filled, aside)
            if out.exists() and not (out.is_dir() and not any(out.iterdir())):
                raise DataError(f"Writing {out}: it exists and is not empty; choose another name or remove it first.")
            try:
                filled.mkdir()
                yield filled
                _replace(out, filled, aside)
            finally:
                _tidy(out, filled, aside)
    finally:
        with suppress(OSError):  # somebody else has begun
            work.rmdir()


def _tidy(out: Path, filled: Path, aside: Path) -> None:
    """Remove what is half done; what was moved aside comes back where nothing took its place."""
    if aside.exists() and not out.exists():
        aside.rename(out)
    for folder in (filled, aside):
        if folder.exists():
            shutil.rmtree(folder)


def _replace(out: Path, filled: Path, aside: Path) -> None:
    """Move a folder into place; what was there comes back when that fails."""
    if out.exists():
        out.rename(aside)
    try:
        filled.rename(out)
    except OSError:
        if aside.exists():
            aside.rename(out)
        raise
