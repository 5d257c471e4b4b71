"""Errors on units that were left out against errors on the same units when they take part: a row an observer, a dot a unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...canvas import Axes, Figure, name_units
from ...error_tables import ErrorTable, left_out_tables
from ...names import in_condition, observer_look
from ...run_folder import NotShownError, RunFolder
from ..rows import best_last, keep_comparable, row_panels, say_diverged

_APART = 0.16


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one panel a state that is not measured, in the condition that was identified on."""
    home = run.identify_on
    table = next((t for t in left_out_tables(run.left_out["rows"], home) if t.condition == home), None)
    if table is None:
        raise NotShownError("no observer was run on a unit that was left out")
    channels = [c for c in run.hidden_states if c in table.channels] or list(table.channels)
    order = best_last(table.cells, channels)
    found = [r for r in run.evaluation["rows"] if r["condition"] == home and r["error_percent"] is not None]
    taking_part = {(r["observer"], r["channel"], r["unit"]): float(r["error_percent"]) for r in found}
    figure, panels = row_panels(channels, order, run.deployed)
    for panel, channel in zip(panels, channels, strict=True):
        _draw_panel(panel, table, channel, order, taking_part)
    return figure, (
        f"Error of every unit{in_condition(home)}, on its held-out episodes. Discs: estimated by observers that were designed without the unit; rings "
        "below: by those of the whole population. Bar: mean over the units that were left out. Logarithmic axes; best on top."
    )


def _draw_panel(
    axes: Axes, table: ErrorTable, channel: str, order: Sequence[str], taking_part: Mapping[tuple[str, str, str], float]
) -> None:
    shown: list[float] = []
    for place, observer in enumerate(order):
        cell = table.cells[observer].get(channel)
        if cell is None:  # not what this observer estimates
            continue
        if cell.mean is None:
            say_diverged(axes, place)
            continue
        colour = observer_look(observer).colour
        estimated = {u: float(v) for u, v in cell.units.items() if v is not None}
        left_out = list(estimated.values())
        others = [v for unit in cell.units if (v := taking_part.get((observer, channel, unit))) is not None]
        axes.plot(others, np.full(len(others), place - _APART), "o", ms=3.4, mfc="none", mec=colour, mew=0.7)
        (discs,) = axes.plot(left_out, np.full(len(left_out), place + _APART), "o", ms=3.4, color=colour, alpha=0.75)
        name_units(discs, list(estimated))
        axes.plot(cell.mean, place + _APART, "|", ms=11, mew=1.6, color=colour)
        shown += [*left_out, *others]
    keep_comparable(axes, shown)
