"""The report: one HTML file with everything in it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..core.artifacts import write_bytes
from ..data.population import DEFAULT_CONDITION
from .advice import advice
from .encode import to_svg
from .figures import draw_all
from .names import condition_label
from .run_folder import RunFolder
from .sections import SECTIONS
from .theme import Tone
from .verdict import findings, trust

_TEMPLATES = Path(__file__).parent / "templates"


def render(run: Path, metrics: Mapping[str, Any]) -> Path:
    """Write `report.html` into a run folder.

    Parameters
    ----------
    run : Path
        Run folder; what it does not have is left out, with the reason.
    metrics : mapping
        As in ``metrics.json``; any part but ``study`` may be absent.

    Returns
    -------
    Path
        The report, written whole or not at all.

    Raises
    ------
    DataError
        When an artifact is broken or of another version.
    """
    path = Path(run) / "report.html"
    write_bytes(path, page(RunFolder(Path(run)), metrics).encode())
    return path


def page(run: RunFolder, metrics: Mapping[str, Any]) -> str:
    """Return the report as HTML."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    figures = {}
    for result in draw_all(run):
        svg = Markup(to_svg(result.drawing.figure, result.name)) if result.drawing else None
        figures[result.name] = {
            "title": result.title,
            "svg": svg,
            "caption": result.drawing.caption if result.drawing else "",
            "reason": result.reason,
        }
    return environment.get_template("report.html.jinja").render(
        name=run.study.get("name", run.folder.name),
        subtitle=_subtitle(metrics),
        verdict={
            "What was found": findings(metrics, run.measured_states),
            "Can it be trusted": trust(metrics),
            "What to do next": advice(metrics, run.measured_states),
        },
        sections=[s for s in (section(run, metrics) for section in SECTIONS) if s is not None],
        figures=figures,
        style=Markup(stylesheet()),
    )


def stylesheet() -> str:
    """Return the page's style with the tones of the figures as variables, for light and dark pages."""
    light = "".join(f"{t.variable}:{t.light};" for t in Tone)
    dark = "".join(f"{t.variable}:{t.dark};" for t in Tone)
    text = (_TEMPLATES / "report.css").read_text(encoding="utf-8")
    return text.replace("/* light tones */", light).replace("/* dark tones */", dark)


def _subtitle(metrics: Mapping[str, Any]) -> str:
    study = metrics["study"]
    return " · ".join([f"{study['units']} units", *(condition_label(c) for c in study["conditions"] if c != DEFAULT_CONDITION)])
