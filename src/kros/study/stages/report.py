"""Stage: write the report; also the entry points of `kros report` and `kros figures`."""

from functools import partial
from pathlib import Path

from ...report import files
from ...report.html import render
from ..config import Stage
from ..engine.context import Context, open_finished
from ..engine.executors import open_executor


def run(context: Context) -> None:
    """Write report.html from the run folder and the metrics so far."""
    from ..metrics import collect_metrics

    metrics = collect_metrics(context, Stage.LEFT_OUT)
    render(context.store.folder, metrics, partial(context.work.map, "report"), context.store.draft("report.html"))


def render_run(folder: Path, workers: int) -> Path:
    """Write the report of a finished run again; `workers` processes draw its figures."""
    with open_finished(folder, alone=True) as context, open_executor(workers) as mapped:
        return render(folder, context.store.metrics(), mapped)


def write_figures(folder: Path, out: Path) -> list[str]:
    """Write the figures of a finished run as PNG and PDF."""
    with open_finished(folder):
        return files.write_figures(folder, out)
