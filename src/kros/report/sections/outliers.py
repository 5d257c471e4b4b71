"""Units that do not belong to the batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..content import Cell, Section, Table
from ..figures.residuals import Names, entry_names, short
from ..names import condition_label, number
from ..run_folder import NotShownError, RunFolder

_MEANING = (
    "Beside every score stands the smallest change that would have been flagged: what the unit would have to exceed the others by, and the smallest change of "
    "gain in one response that does so somewhere. A unit that is “ok” may have any defect that changes its responses by less."
)
_MOST = 5  # flagged units that are described in words


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the scores; None where none were computed."""
    rows = metrics.get("outliers")
    if not rows:
        return None
    flagged = [r for r in rows if r["outlier"]]
    text = (
        "A unit's score is by how much its residual exceeds the cover of all the others, in the direction and at the frequency where it does most. "
        "Scores look at the recordings only, never at serial or group. Some unit always has the highest score, so there is a threshold; above it a unit is "
        "flagged."
    )
    verdict = f"Flagged: {flagged_text(flagged)}." if flagged else "No unit is flagged."
    paragraphs = [text, verdict, *undecided_text(rows), _MEANING, *(score_text(r, _names(run, r)) for r in flagged[:_MOST])]
    more = [("As in the paper, entry by entry", ["outlier_residuals"])]
    return Section("outliers", "Outliers", paragraphs, [_scores(run, rows)], ["outlier_scores", "outlier_ratio"], more=more)


def undecided_text(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return about which units the scores say nothing, and why; nothing where there are none."""
    texts = []
    for status, why in (("not enough data", "too little was recorded of it"), ("cannot tell", "the others are too few, or too unlike")):
        silent = [r for r in rows if r.get("status") == status]
        if silent:
            texts.append(f"{len(silent)} of {len(rows)} scores say nothing about their unit, as {why}: {flagged_text(silent)}.")
    return texts


def score_text(row: Mapping[str, Any], names: Names | None) -> str:
    """Say where and how clearly a flagged unit exceeds the others."""
    text = f"Unit {row['unit']} ({condition_label(row['condition'])}) scores {number(row['score'])} dB"
    if row.get("freq_hz") is None:
        return f"{text}."
    text += f", most at {number(row['freq_hz'])} Hz{_entry(row, names, ' in the response of {0} to {1}')}"
    if row.get("lowest_db") is not None:
        above = "under every choice of the nominal" if row["lowest_db"] > 0 else "under some choices of the nominal only"
        text += f". It exceeds the others {above}, by {number(row['lowest_db'])} to {number(row['highest_db'])} dB"
        text += f"; with {100 * row['agreement']:.0f} % of these nominals alone it would be flagged"
    return f"{text}."


def _entry(row: Mapping[str, Any], names: Names | None, pattern: str) -> str:
    """Name the entry of the residual that is largest, with its row and column."""
    if names is None or row.get("entry") is None:
        return ""
    i, j = row["entry"]
    return pattern.format(short(names[0][i]), short(names[1][j]))


def _names(run: RunFolder, row: Mapping[str, Any]) -> Names | None:
    """Signals behind the entries of the residuals that units are scored by; None where the run does not know."""
    try:
        model = run.outlier_models[row["condition"]]
        return entry_names(model.form, next(m for n, m in run.models.items() if m.lifting.n_lifted == len(model.output_scale)))
    except (NotShownError, KeyError, StopIteration):
        return None


def _scores(run: RunFolder, rows: Sequence[Mapping[str, Any]]) -> Table:
    """Scores of all units, highest first, a group of columns a condition."""
    conditions = list(dict.fromkeys(r["condition"] for r in rows))
    found = {(r["unit"], r["condition"]): r for r in rows}
    names = {c: _names(run, {"condition": c}) for c in conditions}
    scores = {
        u: [float(r["score"]) for r in rows if r["unit"] == u and r.get("score") is not None]
        for u in dict.fromkeys(r["unit"] for r in rows)
    }
    order = sorted(scores, key=lambda u: -max(scores[u], default=float("-inf")))
    cells = [[u, *(cell for c in conditions for cell in _cells(found.get((u, c)), names[c]))] for u in order]
    columns = ["score (dB)", "over nominals (dB)", "at (Hz)", "entry", "status", "flagged from (dB)", "gain (%)"]
    head = ["unit", *(columns * len(conditions))]
    caption = "Outlier scores, highest first; with their range over all nominals, frequency and entry of the residual, and what would have been flagged"
    return Table(head, cells, caption, [("", 1), *((condition_label(c), 7) for c in conditions)], folded=True)


def flagged_text(flagged: list[Mapping[str, Any]]) -> str:
    """Return flagged units with their conditions, for a sentence."""
    units: dict[str, list[str]] = {}
    for row in flagged:
        units.setdefault(row["unit"], []).append(condition_label(row["condition"]))
    return ", ".join(f"{unit} ({', '.join(conditions)})" for unit, conditions in units.items())


def _cells(row: Mapping[str, Any] | None, names: Names | None) -> list[Cell | str]:
    if row is None:
        return ["–"] * 7
    known = row.get("lowest_db") is not None
    shift = row["score"] - row["excess_db"] if known else 0.0  # as the score itself is referred to the threshold
    span = f"{number(row['lowest_db'] + shift)} to {number(row['highest_db'] + shift)}" if known else "–"
    return [
        Cell(number(row["score"]), strong=row["outlier"], note="flagged" if row["outlier"] else ""),
        span,
        number(row.get("freq_hz")),
        _entry(row, names, "{1} → {0}") or "–",
        Cell(row.get("status", "–"), strong=row.get("status", "ok") != "ok"),
        number(row.get("detectable_db")),
        number(row.get("detectable"), 2),
    ]
