"""Every unit: errors of the deployed observer, outlier scores and phase."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ..content import Column, Section, build
from ..names import condition_label, in_condition, number, observer_label, words
from ..verdict import measured_of

Facts = Mapping[str, Any]
_MOST = 400  # rows of the table; metrics.json has all units


def units(metrics: Facts) -> Section | None:
    """Return the table of units, flagged ones first; None where no unit is known."""
    if not metrics.get("units"):
        return None
    study, home = metrics["study"], metrics["study"]["identify_on"]
    name = study.get("deployed")
    errors = {
        (r["unit"], r["channel"]): r
        for r in metrics.get("evaluation", [])
        if r["observer"] == name and r["condition"] == home and r["channel"] not in measured_of(metrics)
    }
    scores = {(r["unit"], r["condition"]): r for r in metrics.get("outliers", [])}
    flagged = {unit for (unit, _), row in scores.items() if row["outlier"]}
    largest = dict.fromkeys((row["unit"] for row in metrics["units"]), 0.0)
    for (unit, _), row in errors.items():
        largest[unit] = max(largest.get(unit, 0.0), math.inf if row["error_percent"] is None else row["error_percent"])
    many = len(largest) > _MOST
    rows = sorted(metrics["units"], key=lambda r: (r["unit"] not in flagged, -largest[r["unit"]] * many, r["unit"]))
    names = [row["unit"] for row in rows[:_MOST]]
    columns = [Column("unit", names), Column("status", [_status(r, flagged, scores) for r in rows[:_MOST]])]
    for channel in dict.fromkeys(c for _, c in errors):
        own = [errors.get((unit, channel), {}) for unit in names]
        group = f"error of {words(channel)}"
        columns.append(Column("%", [r.get("error_percent") for r in own], group))
        columns.append(Column("against the true signal (%)", [r.get("true_error_percent") for r in own], group))
    for condition in dict.fromkeys(c for _, c in scores):
        own = [scores.get((unit, condition), {}).get("score") for unit in names]
        columns.append(Column(f"{condition_label(condition)} (dB)", own, "outlier score"))
    limits = [[r["detectable"] for (u, _), r in scores.items() if u == unit and r.get("detectable")] for unit in names]
    columns.append(Column("detectable change of gain (%)", [max(own, default=None) for own in limits], "outlier score"))
    phases = [row.get("phase_rad") for row in rows[:_MOST]]
    columns.append(Column("phase (°)", [None if p is None else math.degrees(p) for p in phases]))
    cut = "Every unit" if len(rows) <= _MOST else f"{_MOST} of {len(rows)} units, flagged ones and largest errors first"
    table = build(f"{cut}{in_condition(home)}; errors in percent of the largest value", columns, sortable=True)
    text = [f"Errors are those of “{observer_label(name)}”."] if name else []
    figure = "outlier_scores" if scores else ""
    return Section("units", "Units", [*text, *_scores(metrics)], tables=[table], figure=figure)


def _status(row: Facts, flagged: set[str], scores: Mapping[tuple[str, str], Facts]) -> str:
    """Return one word a unit."""
    if row["unit"] in flagged:
        return "flagged"
    own = [r.get("status") for (unit, _), r in scores.items() if unit == row["unit"]]
    silent = bool(own) and all(status in ("not enough data", "cannot tell") for status in own)
    return "undecided" if silent and row.get("status", "ok") == "ok" else str(row.get("status", "ok"))


def _scores(metrics: Facts) -> list[str]:
    """Say how units are scored, and where flagged ones differ."""
    rows = metrics.get("outliers", [])
    if not rows:
        return []
    text = (
        "The outlier score of a unit is the excess of its largest residual over the largest of all other units, in dB. "
        "A unit above the threshold is flagged. A defect that changes every gain by less than the detectable change is not."
    )
    return [text, *(_flagged(r) for r in rows[:_MOST] if r["outlier"])]


def _flagged(row: Facts) -> str:
    """Say where and how clearly a flagged unit differs."""
    text = f"Unit {row['unit']} ({condition_label(row['condition'])}) scores {number(row['score'])} dB"
    if row.get("freq_hz") is not None:
        text += f", most at {number(row['freq_hz'])} Hz"
    if row.get("lowest_db") is not None:
        text += f"; {number(row['lowest_db'])} to {number(row['highest_db'])} dB over the choices of the nominal unit"
    return f"{text}."
