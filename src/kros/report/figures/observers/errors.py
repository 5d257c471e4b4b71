"""Errors of all observers at a glance: a mark for each role of a unit, a row an observer."""

from __future__ import annotations

from ...canvas import Axes, Figure
from ...error_tables import ErrorCell, error_table
from ...names import in_condition, observer_look
from ...run_folder import NotShownError, RunFolder
from ..rows import best_last, keep_comparable, row_panels, say_diverged


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one panel a channel; lines go from the mean to the worst off-nominal unit."""
    table = next((t for t in error_table(run.evaluation["rows"], run.identify_on) if t.condition == run.identify_on), None)
    if table is None:
        raise NotShownError("no observer was run on held-out episodes")
    order = best_last(table.cells, run.hidden_states)
    figure, panels = row_panels(table.channels, order, run.deployed)
    for panel, channel in zip(panels, table.channels, strict=True):
        cells = {place: cell for place, observer in enumerate(order) if (cell := table.cells[observer].get(channel)) is not None}
        for place, cell in cells.items():
            _draw_row(panel, place, cell, observer_look(order[place]).colour)
        keep_comparable(panel, [v for c in cells.values() for v in (c.mean, c.worst, c.nominal) if v is not None])
    return figure, (
        f"RMS error in percent of the largest value{in_condition(run.identify_on)}, held-out episodes. Disc: mean over off-nominal units; bar: worst of "
        "them; ring: nominal unit. Logarithmic axes; best on top by the channels that are not measured; the deployed observer in bold."
    )


def _draw_row(axes: Axes, place: int, cell: ErrorCell, colour: str) -> None:
    if cell.mean is None:
        say_diverged(axes, place)
        return
    if cell.worst is not None:
        axes.plot([cell.mean, cell.worst], [place, place], color=colour, lw=1.6)
        axes.plot(cell.worst, place, "|", ms=8, mew=1.8, color=colour)
    axes.plot(cell.mean, place, "o", ms=5.5, color=colour)
    if cell.nominal is not None:
        axes.plot(cell.nominal, place, "o", ms=6, mfc="none", mec=colour, mew=1.0)
