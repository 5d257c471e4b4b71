"""Figures to bytes: SVG for the page, PNG and PDF for files."""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING

from .canvas import settle
from .theme import Tone, style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 200
_FONTS = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"
_FAMILY = re.compile(r"(?<=px )'DejaVu Sans'(?:, [^;\"]*)?|(?<=font-family: )'?DejaVu Sans'?(?:, [^;\"]*)?")


def to_svg(figure: Figure, name: str) -> str:
    """Return a figure as an inline SVG element whose colours are the page's variables.

    Parameters
    ----------
    figure : Figure
    name : str
        Prefix of all identifiers, so that several figures live on one page.
    """
    buffer = io.StringIO()
    with style():
        settle(figure)
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'(href="#|url\(#)', rf"\g<1>{name}-", text)
    text = re.sub(
        r'^<svg [^>]*?viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" role="img" xmlns:xlink="http://www.w3.org/1999/xlink">', text, count=1
    )
    for tone in Tone:
        text = text.replace(tone.light, f"var({tone.variable})")
    text = _FAMILY.sub(_FONTS, text)
    return _round(text).strip()


def to_png(figure: Figure) -> bytes:
    """Return a figure as PNG, 200 dots an inch."""
    return _bytes(figure, "png", {"Software": None})


def to_pdf(figure: Figure) -> bytes:
    """Return a figure as PDF; the same content gives the same bytes."""
    return _bytes(figure, "pdf", {"CreationDate": None, "Creator": None, "Producer": None})


def _bytes(figure: Figure, kind: str, metadata: dict[str, None]) -> bytes:
    buffer = io.BytesIO()
    with style():
        settle(figure)
        figure.savefig(buffer, format=kind, dpi=_DPI, metadata=metadata)
    return buffer.getvalue()


def _round(text: str) -> str:
    """Shorten coordinates, which stand inside tags, to a hundredth of a point."""
    return re.sub(r"<[^>]*>", lambda tag: re.sub(r"(\d\.\d{2})\d+", r"\1", tag.group()), text)
