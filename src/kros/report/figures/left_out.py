"""Errors on units that were left out against errors on the same units when they take part: a row an observer, a dot a unit.

Needs: the evaluation, and units that were left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..left_out_table import LeftOutTable, left_out_tables
from ..names import condition_label, observer_look
from ..run_folder import NotShownError, RunFolder
from .drawing import Drawing
from .observer_rows import best_last, keep_comparable, row_panels, say_diverged
from .trajectories import states

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAME, TITLE = "left_out", "Units that were left out"
_APART = 0.16
Errors = Mapping[tuple[str, str, str], float]


def draw(run: RunFolder) -> Drawing:
    """Draw one panel a state that is not measured, in the condition that was identified on."""
    tables = {t.condition: t for t in left_out_tables(run.left_out["rows"], run.identify_on)}
    table = tables.get(run.identify_on)
    if table is None:
        raise NotShownError("no observer was run on a unit that was left out")
    channels = [c.name for c in states(run) if not c.measured and c.name in table.channels] or list(table.channels)
    order = best_last(table.cells, channels)
    taking_part = _taking_part(run.evaluation["rows"], run.identify_on)
    figure, panels = row_panels(channels, order, run.deployed)
    for panel, channel in zip(panels, channels, strict=True):
        _draw_panel(panel, table, channel, order, taking_part)
    return Drawing(
        figure,
        f"Error of every unit, {condition_label(run.identify_on)}, on its held-out episodes. Discs: estimated by observers that were made without the unit; "
        "rings below: by those of the whole population. Bar: mean over the units that were left out. Logarithmic axes; best on top.",
    )


def _taking_part(rows: Sequence[Mapping[str, Any]], condition: str) -> Errors:
    found = [r for r in rows if r["condition"] == condition and r["error_percent"] is not None]
    return {(r["observer"], r["channel"], r["unit"]): float(r["error_percent"]) for r in found}


def _draw_panel(axes: Axes, table: LeftOutTable, channel: str, order: Sequence[str], taking_part: Errors) -> None:
    shown: list[float] = []
    for place, observer in enumerate(order):
        cell = table.cells[observer].get(channel)
        if cell is None:  # not what this observer estimates
            continue
        if cell.mean is None:
            say_diverged(axes, place)
            continue
        colour = observer_look(observer).colour
        left_out = [float(v) for v in cell.units.values() if v is not None]
        others = [v for unit in cell.units if (v := taking_part.get((observer, channel, unit))) is not None]
        axes.plot(others, np.full(len(others), place - _APART), "o", ms=3.4, mfc="none", mec=colour, mew=0.7)
        axes.plot(left_out, np.full(len(left_out), place + _APART), "o", ms=3.4, color=colour, alpha=0.75)
        axes.plot(cell.mean, place + _APART, "|", ms=11, mew=1.6, color=colour)
        shown += [*left_out, *others]
    keep_comparable(axes, shown)
