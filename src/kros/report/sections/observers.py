"""Errors of the observers where they were designed for: the result table, and what they do in time and frequency."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...data.population import DEFAULT_CONDITION
from ..content import Cell, Section, Table
from ..error_tables import ErrorCell, ErrorTable, error_table
from ..names import axis_label, channel_units, condition_label, number, observer_label
from ..run_folder import RunFolder


def result(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the tables of all observers and channels, with the chart."""
    tables = error_table(metrics.get("evaluation", []), metrics["study"]["identify_on"])
    if not tables:
        return None
    deployed = metrics["study"].get("deployed")
    measured = run.measured_states
    text = (
        "RMS error on held-out episodes that nothing was fitted to, in percent of the largest absolute value of the signal in the episode. Off nominal: mean "
        "over the units other than the nominal one, with its 95 % interval by a bootstrap over these units, and the "
        "worst of them; RMS: the same mean in the channel's own unit of measure. Best of each column in bold; the deployed observer is set off."
    )
    return Section("results", "Results", [text], [errors(t, deployed, measured, channel_units(metrics)) for t in tables], ["errors"])


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the figures of estimates and their spectra."""
    if not metrics.get("evaluation"):
        return None
    text = (
        "The observers as they run: at every step the estimate is cut back to the original states and re-lifted with the unit's "
        "own parameters. An estimate for the next "
        "sample uses data up to this one."
    )
    return Section("observers", "Observers at work", [text], [], ["observers_in_time", "observers_in_time_paper", "observer_spectra"])


def errors(table: ErrorTable, deployed: str | None, measured: tuple[str, ...] = (), units: Mapping[str, str] | None = None) -> Table:
    """Return one condition's errors as a table, channels that are measured last; `units` of measure by channel, where known."""
    units = units or {}
    channels = sorted(table.channels, key=lambda c: c in measured)
    rows = []
    for observer in table.cells:
        cells = [Cell(observer_label(observer))]
        for channel in channels:
            cells += _cells(table, channel, table.cells[observer].get(channel), channel not in measured)
        rows.append(cells)
    head = ["observer", *(title for c in channels for title in ("nominal", "mean", "worst", axis_label("RMS", units.get(c, ""))))]
    groups = [("", 1), *((c.replace("_", " ") + ("" if c in table.ranked else " (not ranked)"), 4) for c in channels)]
    emphasised = [i for i, o in enumerate(table.cells) if o == deployed]
    where = "" if table.condition == DEFAULT_CONDITION else f", {condition_label(table.condition)}"
    caption = f"Errors in percent of the largest value, and as RMS in the channel's unit{where}."
    if len(table.ranked) < len(table.channels):
        caption += " The current's error under load is the load's torque itself: reported, not ranked."
    return Table(head, rows, caption, groups, emphasised=emphasised)


def _cells(table: ErrorTable, channel: str, cell: ErrorCell | None, with_interval: bool) -> list[Cell]:
    if cell is None:
        return [Cell("–")] * 4
    if cell.mean is None:
        return [Cell(number(cell.nominal)), Cell("diverged", note=f"{cell.diverged} units"), Cell("–"), Cell("–")]
    values = {what: getattr(cell, what) for what in ("nominal", "mean", "worst")}
    notes = {"mean": "" if cell.interval is None or not with_interval else f"{number(cell.interval[0], 2)}–{number(cell.interval[1], 2)}"}
    cells = [Cell(number(v), strong=v is not None and v == table.best(channel, w), note=notes.get(w, "")) for w, v in values.items()]
    return [*cells, Cell(number(cell.rms))]
