"""Stage: write the report; also the entry points of `kros report` and `kros figures`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from ...core.artifacts import read_json
from ..config import Stage
from ..context import Context


def run(context: Context) -> list[Path]:
    """Write report.html from the run folder and the metrics so far."""
    from ...report import render
    from ..metrics import collect_metrics

    return [render(context.store.folder, collect_metrics(context, Stage.LEFT_OUT, None), partial(context.map, "report"))]


def render_run(folder: Path) -> Path:
    """Write the report of a finished run again."""
    from ...report import render

    return render(folder, _metrics(folder))


def write_figures(folder: Path, out: Path) -> list[str]:
    """Write the figures of a finished run as PNG and PDF."""
    from ... import report

    _metrics(folder)
    return report.write_figures(folder, out)


def _metrics(folder: Path) -> dict[str, Any]:
    from ..pipeline import load_run

    _, store = load_run(folder)
    store.verify(*[stage for stage in Stage if stage is not Stage.REPORT])
    metrics: dict[str, Any] = read_json(Path(folder) / "metrics.json")
    return metrics
