"""Every unit: errors of the deployed observer, outlier scores and phase."""

import math
from collections.abc import Sequence
from operator import itemgetter

from ...core import ByName, grouped
from ..content import Column, Row, Section, build
from ..facts import Facts
from ..names import in_condition, words
from ..theme import DRAWING

_ERRORS = {"error (%)": "error_percent", "against the true signal (%)": "true_error_percent"}
_OF_SCORES = {
    "score (dB)": "score",
    "most at (Hz)": "freq_hz",
    "detectable change of gain (%)": "detectable",
    "recordings needed (s)": "needed_s",
}
_SCORES = (
    "The outlier score of a unit is the excess of its largest residual over the largest of all other units, in dB. A "
    "unit above the threshold is flagged. A change of a hidden state's gain below the detectable one is not."
)


def units(facts: Facts) -> Section | None:
    """Return the table of units, flagged ones first; None where no unit is known."""
    if not facts.get("units"):
        return None
    scores, home = facts.get("outliers"), facts.study["identify_on"]
    errors = [
        r
        for r in facts.get("evaluation")
        if r["observer"] == facts.deployed and r["condition"] == home and r["channel"] not in facts.measured
    ]
    columns = [Column("unit"), Column("status")]
    for channel in dict.fromkeys(r["channel"] for r in errors):
        columns += [Column(title, (channel, key), words(channel)) for title, key in _ERRORS.items()]
    for condition in dict.fromkeys(r["condition"] for r in scores):
        group = f"outlier test{in_condition(condition)}"
        columns += [Column(title, (condition, key), group) for title, key in _OF_SCORES.items()]
    errors_of, scores_of = (grouped(known, itemgetter("unit")) for known in (errors, scores))
    rows = [_row(r, errors_of.get(r["unit"], ()), scores_of.get(r["unit"], ())) for r in facts.get("units")]
    rows.sort(key=lambda row: (row["status"] != "flagged", -row["largest"], row["unit"]))
    shown = rows[: DRAWING.units]
    order = f"units{in_condition(home)}, flagged ones and largest errors first"
    caption = f"{len(shown)} of {len(rows)} {order}; errors in percent of the largest value"
    table = build(caption, [*columns, Column("phase (°)", "phase")], shown, sortable=True)
    text = [f"Errors are those of “{facts.label}”."] if facts.deployed else []
    text += [_SCORES] if scores else []
    return Section("units", "Units", [" ".join(text)], tables=[table], figure="outlier_scores" if scores else "")


def _row(row: ByName, errors: Sequence[ByName], scores: Sequence[ByName]) -> Row:
    """Return what is known of a unit: errors by channel, scores by condition."""
    known = {(r["channel"], key): r.get(key) for r in errors for key in _ERRORS.values()}
    for r in scores:
        needed = r["needed_s"] if r.get("status") == "not enough data" else None
        score = {**r, "detectable": max(r.get("detectable", {}).values(), default=None), "needed_s": needed}
        known |= {(r["condition"], key): score.get(key) for key in _OF_SCORES.values()}
    percent = [math.inf if r["error_percent"] is None else r["error_percent"] for r in errors]
    phase = row.get("phase_rad")
    about = {"unit": row["unit"], "status": _status(row, scores), "largest": max(percent, default=0.0)}
    return about | {"phase": None if phase is None else math.degrees(phase)} | known


def _status(row: ByName, scores: Sequence[ByName]) -> str:
    """Return one word a unit."""
    if any(r["outlier"] for r in scores):
        return "flagged"
    silent = bool(scores) and all(r.get("status") in ("not enough data", "cannot tell") for r in scores)
    status = str(row.get("status", "ok"))
    return "undecided" if silent and status == "ok" else status
