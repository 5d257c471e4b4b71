"""Figures to bytes and files: SVG for the page, PNG and PDF for papers and slides."""

import io
import logging
import re
from html import escape
from pathlib import Path

from ..core import ConfigError, write_bytes
from .canvas import Figure
from .figures import FIGURES, draw
from .run_folder import RunFolder
from .theme import DRAWING, Tone, style

log = logging.getLogger(__name__)

_METADATA = {"svg": "Date Creator Format Type", "png": "Software", "pdf": "CreationDate Creator Producer"}  # left out
_FONTS = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"
_FAMILY = re.compile(r"(?<=px )'DejaVu Sans'(?:, [^;\"]*)?|(?<=font-family: )'?DejaVu Sans'?(?:, [^;\"]*)?")
_COORDINATES = re.compile(r'(?<= )(?:d|x|y|transform)="[^"]*"')
_BEYOND = re.compile(r"(?<=\d\.\d\d)\d+")  # a hundredth of a point is enough


def write_figures(run: Path, out: Path) -> list[str]:
    """Write every figure of a run as PNG and PDF to a folder; return the names of the files in their order."""
    if out.exists() and not out.is_dir():
        raise ConfigError(f"Figures to {out}: is a file; name a folder.")
    names, folder = [], RunFolder(run)  # what several figures show is read once
    for name in FIGURES:
        drawn = draw(name, folder)
        if drawn.figure is None:
            log.warning("figure %s is left out: %s", drawn.name, drawn.reason)
            continue
        for suffix in ("png", "pdf"):
            write_bytes(out / f"{drawn.name}.{suffix}", _encode(drawn.figure, suffix))
            names.append(f"{drawn.name}.{suffix}")
    return names


def to_svg(figure: Figure, name: str, title: str) -> str:
    """Return a figure as an inline SVG element in the page's colours; `name` is the prefix of all identifiers."""
    text = _encode(figure, "svg").decode()
    text = text[text.index("<svg") :]
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'(href="#|url\(#)', rf"\g<1>{name}-", text)
    opening = rf'<svg viewBox="\1" role="img" aria-label="{escape(title)}" xmlns:xlink="http://www.w3.org/1999/xlink">'
    text = re.sub(r'^<svg [^>]*?viewBox="([^"]*)"[^>]*>', opening, text, count=1)
    for tone in Tone:
        text = text.replace(tone, f"var({tone.variable})")
    text = _FAMILY.sub(_FONTS, text)
    return _COORDINATES.sub(lambda match: _BEYOND.sub("", match.group()), text).strip()


def _encode(figure: Figure, kind: str) -> bytes:
    """Return a figure as SVG, PNG or PDF; the same content gives the same bytes."""
    buffer, unstated = io.BytesIO(), dict.fromkeys(_METADATA[kind].split())
    with style():
        if (engine := figure.get_layout_engine()) is not None:  # once: every file would lay it out again
            engine.execute(figure)
            figure.set_layout_engine(None)
        figure.savefig(buffer, format=kind, dpi=DRAWING.dots_per_inch, transparent=kind == "svg", metadata=unstated)
    return buffer.getvalue()
