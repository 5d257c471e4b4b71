"""The report: one HTML file with everything in it."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ..core import ByName, Mapped, Record, read_json, write_bytes
from .content import Section
from .facts import Facts
from .figures import Drawn, draw
from .files import to_svg
from .names import condition_label
from .run_folder import RunFolder
from .sections import EVIDENCE, FIRST
from .theme import Tone
from .verdict import judge

_TEMPLATES = Path(__file__).parent / "templates"


def render(run: Path, metrics: ByName, mapped: Mapped = map, out: Path | None = None) -> Path:
    """Write the report of a run from ``metrics.json``, of which any part but ``study`` may be absent.

    `mapped` maps the drawing of a figure over their names, in order, for example in several processes.
    """
    facts, path = Facts(metrics), out or run / "report.html"
    parts = [[s for make in makers if (s := make(facts)) is not None] for makers in (FIRST, EVIDENCE)]
    names = [section.figure for part in parts for section in part if section.figure]
    figures = {drawn.name: drawn for drawn in mapped(partial(encoded, RunFolder(run)), names)}
    conditions = filter(None, map(condition_label, facts.study["conditions"]))
    subtitle = " · ".join([f"{facts.study['units']} units", *conditions])
    name = read_json(run / "study.json").get("name", run.name)
    write_bytes(path, filled(name, subtitle, parts[0], evidence=parts[1], figures=figures, head=judge(facts)).encode())
    return path


def filled(name: str, subtitle: str, sections: Sequence[Section], **parts: Any) -> str:
    """Return a page of sections; `parts` are a summary, more sections as evidence, and figures by name."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(_TEMPLATES)
    pages = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    shown: Record = {
        "head": None,
        "evidence": (),
        "figures": {},
        "name": name,
        "subtitle": subtitle,
        "sections": sections,
        "light": "".join(f"{t.variable}:{t};" for t in Tone),  # the tones of the figures, for light and dark pages
        "dark": "".join(f"{t.variable}:{t.dark};" for t in Tone),
    }
    return pages.get_template("report.html.jinja").render(shown | parts)


def encoded(run: RunFolder, name: str) -> Drawn:
    """Draw a figure as the page shows it."""
    drawn = draw(name, run)
    return replace(drawn, svg="" if drawn.figure is None else to_svg(drawn.figure, name, drawn.title), figure=None)
