"""Observers on units that took no part in their design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..content import Cell, Section, Table, where
from ..error_tables import PAPER, ErrorCell, ErrorTable, left_out_tables
from ..names import axis_label, channel_units, in_condition, minus, number, observer_label
from ..run_folder import RunFolder


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return a table for every condition, and the figure; None where no unit was left out."""
    found = metrics.get("left_out")
    if not found or not found["rows"]:
        return None
    folds = len(found["folds"])
    text = (
        f"The units are divided into {folds} folds, and for each fold the whole study is repeated on all other units: calibration, models, weights, observers, "
        "their tuning, and what is learned. Its observers run on the fold's own units, as they would on new machines: a unit's phase comes from its own "
        "training episodes. Errors in percent of the largest value on held-out episodes: mean over the units with its 95 % interval, and the worst unit."
    )
    certified = (
        "Certified as it runs: a bound on the error with re-lifting at every step, from the model's own rows. Certified for the set: a bound on the error "
        "for every machine inside the uncertain set of the fold's units. Both count folds."
    )
    paragraphs = [text, certified, *(f"Fold {int(n) + 1} failed: {reason}" for n, reason in found["failed"].items())]
    study = metrics["study"]
    units = channel_units(metrics)
    tables = [
        _table(table, found["observers"], folds, run.measured_states, study.get("deployed"), units)
        for table in left_out_tables(found["rows"], study["identify_on"])
    ]
    return Section("left-out", "On units that were left out", paragraphs, tables)


def _table(
    table: ErrorTable,
    facts: Mapping[str, Mapping[str, Any]],
    folds: int,
    measured: Sequence[str],
    deployed: str | None,
    units: Mapping[str, str],
) -> Table:
    channels = table.hidden(measured)
    powers = any(cell.band_db is not None for cells in table.cells.values() for cell in cells.values())
    rows = []
    for observer, cells in table.cells.items():
        own = facts[observer]
        made = "" if own["made"] == folds else f"in {own['made']} of {folds} folds"
        row: list[Cell | str] = [Cell(observer_label(observer), note=made), "/".join(map(str, own["orders"])) or "–"]
        row += ["–" if own[key] is None else f"{own[key]}/{folds}" for key in ("relift_certified", "robust")]
        for channel in channels:
            row += _cells(table, channel, cells.get(channel, ErrorCell()), powers)
        rows.append(row)
    head = ["mean (%)", "worst (%)", *(["band (dB)"] if powers else [])]
    titles = [c.replace("_", " ") + ("" if c in table.ranked else " (not ranked)") for c in channels]
    groups = [("", 2), ("certified", 2), *((title, 1 + len(head)) for title in titles)]
    caption = f"Errors on units that were left out{in_condition(table.condition)}: RMS, and percent of the largest value with the mean's 95 % interval."
    if powers:
        caption += f" Band: power of the error around the gearbox frequency, relative to “{observer_label(PAPER)}”."
    of_channels = [title for c in channels for title in (axis_label("RMS", units.get(c, "")), *head)]
    head = ["observer", "states", "as it runs", "for the set", *of_channels]
    return Table(head, rows, caption, groups, emphasised=where(table.cells, deployed), sortable=True)


def _cells(table: ErrorTable, channel: str, cell: ErrorCell, powers: bool) -> list[Cell | str]:
    extra = ["–" if cell.band_db is None else minus(f"{cell.band_db:.1f}")] if powers else []
    if cell.mean is None:
        return ["–", "diverged" if cell.diverged else "–", "–", *extra]
    notes = {"mean": "–".join(number(v, 2) for v in cell.interval)} if cell.interval else {}
    values = {what: getattr(cell, what) for what in ("mean", "worst")}
    cells = [
        Cell(number(v), strong=v == table.best(channel, w), note=notes.get(w, ""), value=v) for w, v in values.items()
    ]
    return [Cell(number(cell.rms), value=cell.rms), *cells, *extra]
