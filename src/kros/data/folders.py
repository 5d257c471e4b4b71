"""A folder that appears whole or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..core.errors import DataError


@contextmanager
def whole_folder(out: Path, overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary sibling of `out` to fill; it is moved there at the end, or removed when anything fails.

    Parameters
    ----------
    out : Path
        An empty folder at this place is replaced.
    overwrite : bool
        Replace a folder with content too.

    Raises
    ------
    DataError
        `out` exists and is not an empty folder.
    """
    occupied = out.exists() and not (out.is_dir() and not any(out.iterdir()))
    if occupied and not (overwrite and out.is_dir()):
        raise DataError(f"Writing {out}: it exists and is not empty; choose another name or remove it first.")
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=out.absolute().parent, prefix=f".{out.name}."))
    try:
        filled = temporary / "new"
        filled.mkdir()
        yield filled
        _replace(out, filled, temporary / "old")
    finally:
        shutil.rmtree(temporary)


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
