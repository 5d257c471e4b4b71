"""Observers on units that took no part in their making."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ...data.population import DEFAULT_CONDITION
from ..content import Cell, Section, Table
from ..error_tables import PAPER, ErrorCell, ErrorTable, left_out_tables
from ..names import condition_label, minus, number, observer_label
from ..run_folder import RunFolder


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return a table for every condition, and the figure; None where no unit was left out."""
    found = metrics.get("left_out")
    if not found or not found["rows"]:
        return None
    folds = len(found["folds"])
    text = (
        f"The units are parted into {folds} folds, and for each fold the whole study is made on all other units: calibration, models, weights, observers, "
        "their tuning, and what is learned. Its observers run on the fold's own units, as they would on new machines: a unit's phase comes from its own "
        "training episodes. Errors in percent of the largest value on held-out episodes: mean over the units with its 95 % interval, and the worst unit."
    )
    certified = (
        "Certified as it runs: a bound on the error with re-lifting at every step, from the model's own rows. Certified for the set: a bound on the error "
        "for every machine inside the uncertain set of the fold's units. Both count folds."
    )
    paragraphs = [text, certified, *(f"Fold {int(n) + 1} failed: {reason}" for n, reason in found["failed"].items())]
    measured, study = run.measured_states, metrics["study"]
    shown = left_out_tables(found["rows"], study["identify_on"])
    tables = [_table(table, found["observers"], folds, measured, study.get("deployed")) for table in shown]
    return Section("left-out", "On units that were left out", paragraphs, tables, ["left_out"])


def _table(table: ErrorTable, facts: Mapping[str, Mapping[str, Any]], folds: int, measured: Sequence[str], deployed: str | None) -> Table:
    channels = [c for c in table.channels if c not in measured] or list(table.channels)
    powers = any(cell.band_db is not None for cells in table.cells.values() for cell in cells.values())
    rows = []
    for observer, cells in table.cells.items():
        own = facts[observer]
        made = "" if own["made"] == folds else f"in {own['made']} of {folds} folds"
        row = [Cell(observer_label(observer), note=made), Cell("/".join(map(str, own["orders"])) or "–")]
        row += [Cell(_count(own[key], folds)) for key in ("relift_certified", "robust")]
        for channel in channels:
            row += _cells(table, channel, cells.get(channel), powers)
        rows.append(row)
    head = ["mean", "95 %", "worst", *(["band (dB)"] if powers else [])]
    titles = [c.replace("_", " ") + ("" if c in table.ranked else " (not ranked)") for c in channels]
    groups = [("", 2), ("certified", 2), *((title, len(head)) for title in titles)]
    where = "" if table.condition == DEFAULT_CONDITION else f", {condition_label(table.condition)}"
    caption = f"Errors on units that were left out, percent of the largest value{where}. Best in bold."
    if powers:
        caption += f" Band: power of the error around the gearbox frequency, relative to “{observer_label(PAPER)}”."
    emphasised = [i for i, observer in enumerate(table.cells) if observer == deployed]
    head = ["observer", "states", "as it runs", "for the set", *(head * len(channels))]
    return Table(head, rows, caption, groups, emphasised=emphasised)


def _count(value: int | None, folds: int) -> str:
    return "–" if value is None else f"{value}/{folds}"


def _cells(table: ErrorTable, channel: str, cell: ErrorCell | None, powers: bool) -> list[Cell]:
    extra = [Cell("–" if cell is None or cell.band_db is None else minus(f"{cell.band_db:.1f}"))] if powers else []
    if cell is None:
        return [Cell("–")] * 3 + extra
    if cell.mean is None:
        return [Cell("diverged"), Cell("–"), Cell("–"), *extra]
    interval = "–" if cell.interval is None else "–".join(map(number, cell.interval))
    mean, worst = (Cell(number(getattr(cell, what)), strong=getattr(cell, what) == table.best(channel, what)) for what in ("mean", "worst"))
    return [mean, Cell(interval), worst, *extra]
