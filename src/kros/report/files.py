"""Figures as files, for papers and slides."""

from __future__ import annotations

import logging
from pathlib import Path

from ..core.artifacts import write_bytes
from ..core.errors import ConfigError
from .encode import to_pdf, to_png
from .figures import draw_all
from .run_folder import RunFolder

log = logging.getLogger(__name__)


def write_figures(run: Path, out: Path) -> list[str]:
    """Write every figure of a run as PNG (200 dots an inch) and PDF.

    Parameters
    ----------
    run : Path
        Run folder; figures whose artifacts it does not have are left out and logged.
    out : Path
        Folder for the files; made where it is missing.

    Returns
    -------
    list of str
        Names of the files written, in the order of the report.

    Raises
    ------
    ConfigError
        When `out` is a file.
    """
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"Figures to {out}: is a file; name a folder.")
    names = []
    for result in draw_all(RunFolder(Path(run))):
        if result.drawing is None:
            log.warning("figure %s is left out: %s", result.name, result.reason)
            continue
        for suffix, encode in (("png", to_png), ("pdf", to_pdf)):
            write_bytes(out / f"{result.name}.{suffix}", encode(result.drawing.figure))
            names.append(f"{result.name}.{suffix}")
    return names
