"""Every unit: its errors, score, residual and phase in a table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...core.artifacts import load_artifact
from ..content import Cell, Cells, Section, Table
from ..names import axis_label, channel_units, condition_label, in_condition, number, observer_label
from ..run_folder import RunFolder
from .outliers import some_of, undecided_text

Row = Mapping[str, Any]
_ROWS = 400  # units that all get a row; more would make the page too large
_FAR = 20  # largest of every column that get a row where not all do
_SHARES = {"5 %": 0.05, "median": 0.5, "95 %": 0.95}


@dataclass
class _Known:
    """What the metrics and the run know of one unit, part by part."""

    own: Row = field(default_factory=dict)
    errors: list[Row] = field(default_factory=list)
    scores: list[Row] = field(default_factory=list)
    bound: Row = field(default_factory=dict)


def section(run: RunFolder, metrics: Row) -> Section | None:
    """Return the table of units; None where no unit is known."""
    if not metrics.get("units"):
        return None
    found, name = _known(run, metrics), metrics["study"].get("deployed")
    hidden = [
        c
        for c in dict.fromkeys(r["channel"] for known in found.values() for r in known.errors)
        if c not in run.measured_states
    ]
    flagged = [unit for unit, known in found.items() if any(r["outlier"] for r in known.scores)]
    named = some_of(flagged)
    text = f"Errors are those of “{observer_label(name)}”. " if name else ""
    text += f"Flagged as not belonging to the batch: {named}." if flagged else "No unit is flagged."
    shown, tables = found, list[Table]()
    if len(found) > _ROWS:
        columns = _columns(metrics, found, hidden)
        shown, tables = _extremes(found, columns), [_quantiles(columns, len(found))]
    cut = (
        "Every unit"
        if shown is found
        else f"{len(shown)} of {len(found)} units, those flagged and the {_FAR} largest of every column; metrics.json has all"
    )
    tables.append(_table(run, metrics, shown, hidden, cut))
    return Section("units", "Units", [text, *undecided_text(metrics.get("outliers", []))], tables)


def _columns(metrics: Row, found: Mapping[str, _Known], hidden: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return numbers of units by what they are and unit, where they are known."""
    home = metrics["study"]["identify_on"]
    columns: dict[str, dict[str, float]] = {f"error of {c.replace('_', ' ')} (%)": {} for c in hidden}
    for unit, known in found.items():
        for row in known.errors:
            if row["channel"] in hidden and row["condition"] == home:
                columns[f"error of {row['channel'].replace('_', ' ')} (%)"][unit] = (
                    math.inf if row["error_percent"] is None else row["error_percent"]
                )
        for row in known.scores:
            if row["score"] is not None:
                columns.setdefault(f"outlier score, {condition_label(row['condition'])} (dB)", {})[unit] = row["score"]
        if known.bound.get("residual") is not None:
            columns.setdefault("residual", {})[unit] = known.bound["residual"]
    return {title: values for title, values in columns.items() if values}


def _extremes(found: Mapping[str, _Known], columns: Mapping[str, Mapping[str, float]]) -> dict[str, _Known]:
    """Return the units that are flagged, and those that are the largest in some column."""
    flagged = [unit for unit, known in found.items() if any(r["outlier"] for r in known.scores)]
    largest = [unit for values in columns.values() for unit in sorted(values, key=lambda u: -values[u])[:_FAR]]
    return {unit: found[unit] for unit in list(dict.fromkeys(flagged + largest))[:_ROWS]}


def _quantiles(columns: Mapping[str, Mapping[str, float]], units: int) -> Table:
    """Return how numbers of units are spread, with the unit that is at the upper end."""
    rows: list[Cells] = []
    for title, values in columns.items():
        numbers, last = np.array(list(values.values())), max(values, key=lambda u: values[u])
        inner = [number(float(np.quantile(numbers, share, method="nearest"))) for share in _SHARES.values()]
        rows.append(
            [title, str(len(numbers)), number(float(numbers.min())), *inner, number(float(numbers.max())), last]
        )
    return Table(["", "units", "smallest", *_SHARES, "largest", "which is"], rows, f"How {units} units are spread")


def _known(run: RunFolder, metrics: Row) -> dict[str, _Known]:
    """Collect what is known of every unit, those that are flagged first, then by name."""
    name = metrics["study"].get("deployed")
    found = {row["unit"]: _Known(row) for row in metrics["units"]}
    for row in metrics.get("evaluation", []):
        if row["observer"] == name and row["unit"] in found:
            found[row["unit"]].errors.append(row)
    for row in metrics.get("outliers", []):
        if row["unit"] in found:
            found[row["unit"]].scores.append(row)
    if run.has("observers/relift.json"):
        for row in load_artifact(run.folder / "observers", "relift")[0]["rows"].get(name, []):
            if row["unit"] in found:
                found[row["unit"]].bound = row
    return dict(sorted(found.items(), key=lambda item: (not any(r["outlier"] for r in item[1].scores), item[0])))


def _table(run: RunFolder, metrics: Row, found: Mapping[str, _Known], hidden: Sequence[str], cut: str) -> Table:
    home, units = metrics["study"]["identify_on"], channel_units(metrics)
    conditions = list(dict.fromkeys(r["condition"] for r in metrics.get("outliers", [])))
    rows: list[Cells] = []
    for unit, known in found.items():
        status = "flagged" if any(r["outlier"] for r in known.scores) else known.own.get("status", "ok")
        row: list[Cell | str] = [unit, Cell(status, strong=status != "ok")]
        errors = {r["channel"]: r for r in known.errors if r["condition"] == home}
        for channel in hidden:
            own = errors.get(channel, {})
            row += [_cell(own.get("rms")), _cell(own.get("error_percent"))]
        scores = {r["condition"]: r for r in known.scores}
        row += [
            _cell(scores.get(c, {}).get("score"), strong=bool(scores.get(c, {}).get("outlier"))) for c in conditions
        ]
        row += [_cell(known.bound.get("residual"))] if any(k.bound for k in found.values()) else []
        row += [_cell(_degrees(known.own.get("phase_rad")))] if run.calibrated else []
        rows.append(row)
    head = ["unit", "status", *(t for c in hidden for t in (axis_label("RMS", units.get(c, "")), "%"))]
    head += [f"{condition_label(c)} (dB)" for c in conditions]
    groups = [
        ("", 2),
        *((f"error of {c.replace('_', ' ')}", 2) for c in hidden),
        *([("outlier score", len(conditions))] if conditions else []),
    ]
    last = [*(["residual"] if any(k.bound for k in found.values()) else []), *(["phase (°)"] if run.calibrated else [])]
    caption = f"{cut}{in_condition(home)}; % of the largest value, the residual relative to the population's"
    return Table([*head, *last], rows, caption, [*groups, *([("", len(last))] if last else [])], sortable=True)


def _cell(value: float | None, strong: bool = False) -> Cell:
    return Cell(number(value), strong=strong, value=value)


def _degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else math.degrees(angle_rad)
