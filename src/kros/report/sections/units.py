"""Every unit: errors of the deployed observer, outlier scores and phase."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from ...core import ByName
from ..content import Column, Section, build
from ..facts import Facts
from ..names import in_condition, number, words
from ..theme import DRAWING

_ERRORS = {"error (%)": "error_percent", "against the true signal (%)": "true_error_percent"}
_OF_SCORES = {"score (dB)": "score", "detectable change of gain (%)": "detectable"}
_SCORES = (
    "The outlier score of a unit is the excess of its largest residual over the largest of all other units, in dB. A "
    "unit above the threshold is flagged. A defect that changes every gain by less than the detectable change is not."
)


def units(facts: Facts) -> Section | None:
    """Return the table of units, flagged ones first; None where no unit is known."""
    if not facts.get("units"):
        return None
    rows, home = facts.get("outliers", []), facts.study["identify_on"]
    errors = {
        (r["unit"], r["channel"]): r
        for r in facts.get("evaluation", [])
        if r["observer"] == facts.deployed and r["condition"] == home and r["channel"] not in facts.measured
    }
    scores = {(r["unit"], r["condition"]): r for r in rows}
    shown = _first(facts.get("units"), errors, {r["unit"] for r in rows if r["outlier"]})
    names = [row["unit"] for row in shown]
    phases = [row.get("phase_rad") for row in shown]
    columns = [
        Column("unit", names),
        Column("status", [_status(row, [r for r in rows if r["unit"] == row["unit"]]) for row in shown]),
        *_columns(names, errors, _ERRORS, words),
        *_columns(names, scores, _OF_SCORES, lambda condition: f"outlier test{in_condition(condition)}"),
        Column("phase (°)", [None if p is None else math.degrees(p) for p in phases]),
    ]
    order = f"units{in_condition(home)}, flagged ones and largest errors first"
    count = f"{len(shown)} of {len(facts.get('units'))} {order}"
    table = build(f"{count}; errors in percent of the largest value", columns, sortable=True)
    text = [f"Errors are those of “{facts.label}”."] if facts.deployed else []
    text += [_SCORES, *(_flagged(r) for r in rows[: DRAWING.units] if r["outlier"])] if rows else []
    return Section("units", "Units", [" ".join(text)], tables=[table], figure="outlier_scores" if rows else "")


def _first(rows: Sequence[ByName], errors: Mapping[tuple[str, str], ByName], flagged: set[str]) -> list[ByName]:
    """Return flagged units, then those with the largest errors; of very many units the first ones."""
    largest = dict[str, float]()
    for (unit, _), row in errors.items():
        error = math.inf if row["error_percent"] is None else row["error_percent"]
        largest[unit] = max(largest.get(unit, 0.0), error)
    ordered = sorted(rows, key=lambda r: (r["unit"] not in flagged, -largest.get(r["unit"], 0.0), r["unit"]))
    return ordered[: DRAWING.units]


def _columns(
    names: Sequence[str], rows: Mapping[tuple[str, str], ByName], keys: Mapping[str, str], group: Callable[[str], str]
) -> list[Column]:
    """Return columns of what rows by unit, and by channel or condition, hold."""
    return [
        Column(title, [rows.get((unit, place), {}).get(key) for unit in names], group(place))
        for place in dict.fromkeys(place for _, place in rows)
        for title, key in keys.items()
    ]


def _status(row: ByName, scores: Sequence[ByName]) -> str:
    """Return one word a unit."""
    if any(r["outlier"] for r in scores):
        return "flagged"
    silent = bool(scores) and all(r.get("status") in ("not enough data", "cannot tell") for r in scores)
    status = str(row.get("status", "ok"))
    return "undecided" if silent and status == "ok" else status


def _flagged(row: ByName) -> str:
    """Say where and how clearly a flagged unit differs."""
    text = f"Unit {row['unit']}{in_condition(row['condition'])}: score {number(row['score'])} dB"
    text += f", most at {number(row['freq_hz'])} Hz" if row.get("freq_hz") is not None else ""
    if row.get("lowest_db") is not None:
        text += f"; {number(row['lowest_db'])} to {number(row['highest_db'])} dB over the choices of the nominal unit"
    return f"{text}."
