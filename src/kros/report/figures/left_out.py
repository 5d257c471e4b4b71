"""Errors on units that were left out against errors on the same units when they take part: a row an observer, a dot a unit.

Needs: the evaluation, and units that were left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..canvas import grid
from ..left_out_table import LeftOutTable, left_out_tables
from ..names import condition_label, observer_label, observer_look
from ..run_folder import NotShownError, RunFolder
from ..theme import Tone
from .drawing import Drawing
from .errors_chart import plain_log_ticks
from .trajectories import states

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAME, TITLE = "left_out", "Units that were left out"
_APART, _COMPARABLE = 0.16, 1e4
Errors = Mapping[tuple[str, str, str], float]


def draw(run: RunFolder) -> Drawing:
    """Draw one panel a state that is not measured, in the condition that was identified on."""
    tables = {t.condition: t for t in left_out_tables(run.left_out["rows"], run.identify_on)}
    table = tables.get(run.identify_on)
    if table is None:
        raise NotShownError("no observer was run on a unit that was left out")
    channels = [c.name for c in states(run) if not c.measured and c.name in table.channels] or list(table.channels)
    order = sorted(table.cells, key=lambda o: -_order(table, o, channels))
    taking_part = _taking_part(run.evaluation["rows"], run.identify_on)
    figure, axes = grid(1, len(channels), 0.36 * len(order) + 0.75, legend_rows=0, sharey=True)
    for panel, channel in zip(axes[0], channels, strict=True):
        panel.set_xscale("log")
        _draw_panel(panel, table, channel, order, taking_part)
        panel.set_title(channel.replace("_", " "))
        panel.set_xlabel("error (% of range)")
        panel.grid(visible=False, axis="y")
    axes[0, 0].set_yticks(range(len(order)), [observer_label(o) for o in order])
    for label, observer in zip(axes[0, 0].get_yticklabels(), order, strict=True):
        label.set_fontweight("bold" if observer == run.deployed else "normal")
    axes[0, 0].set_ylim(-0.6, len(order) - 0.4)
    return Drawing(
        figure,
        f"Error of every unit, {condition_label(run.identify_on)}, on its held-out episodes. Discs: estimated by observers that were made without the unit; "
        "rings below: by those of the whole population. Bar: mean over the units that were left out. Logarithmic axes; best on top.",
    )


def _taking_part(rows: Sequence[Mapping[str, Any]], condition: str) -> Errors:
    found = [r for r in rows if r["condition"] == condition and r["error_percent"] is not None]
    return {(r["observer"], r["channel"], r["unit"]): float(r["error_percent"]) for r in found}


def _order(table: LeftOutTable, observer: str, channels: Sequence[str]) -> float:
    """Mean logarithm of the mean errors; infinite where one diverged."""
    found = [table.cells[observer][c].mean for c in channels if c in table.cells[observer]]
    means = [m for m in found if m is not None and m > 0]
    return float(np.mean(np.log(means))) if means and len(means) == len(found) else np.inf


def _draw_panel(axes: Axes, table: LeftOutTable, channel: str, order: Sequence[str], taking_part: Errors) -> None:
    shown: list[float] = []
    for place, observer in enumerate(order):
        cell = table.cells[observer].get(channel)
        if cell is None:  # not what this observer estimates
            continue
        if cell.mean is None:
            place_of = ("axes fraction", "data")
            axes.annotate("diverged", (0.98, place), xycoords=place_of, ha="right", va="center", size=7, color=Tone.SOFT.light)
            continue
        colour = observer_look(observer).colour
        left_out = [float(v) for v in cell.units.values() if v is not None]
        others = [v for unit in cell.units if (v := taking_part.get((observer, channel, unit))) is not None]
        axes.plot(others, np.full(len(others), place - _APART), "o", ms=3.4, mfc="none", mec=colour, mew=0.7)
        axes.plot(left_out, np.full(len(left_out), place + _APART), "o", ms=3.4, color=colour, alpha=0.75)
        axes.plot(cell.mean, place + _APART, "|", ms=11, mew=1.6, color=colour)
        shown += [v for v in (*left_out, *others) if v > 0]
    if shown:
        plain_log_ticks(axes, [v for v in shown if v <= _COMPARABLE * min(shown)])
