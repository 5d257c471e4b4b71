"""Units that do not belong to the batch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..content import Cell, Section, Table
from ..names import condition_label, number
from ..run_folder import RunFolder


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the scores; None where none were computed."""
    rows = metrics.get("outliers")
    if not rows:
        return None
    flagged = [r for r in rows if r["outlier"]]
    text = (
        "A unit's score is how far its residual sticks out of the cover of all the others, in whatever direction and at whatever "
        "frequency it does most. Scores look at the "
        "recordings only, never at serial or group."
    )
    verdict = f"Flagged: {flagged_text(flagged)}." if flagged else "No unit is flagged."
    conditions = list(dict.fromkeys(r["condition"] for r in rows))
    units = list(dict.fromkeys(r["unit"] for r in rows))
    found = {(r["unit"], r["condition"]): r for r in rows}
    order = sorted(units, key=lambda u: -max((_score(found, u, c) for c in conditions), default=0.0))
    cells = [[Cell(u), *(_cell(found.get((u, c))) for c in conditions)] for u in order]
    table = Table(["unit", *(condition_label(c) for c in conditions)], cells, "Outlier scores, highest first", folded=True)
    return Section("outliers", "Outliers", [text, verdict], [table], ["outlier_scores", "outlier_residuals"])


def flagged_text(flagged: list[Mapping[str, Any]]) -> str:
    """Return flagged units with their conditions, for a sentence."""
    units: dict[str, list[str]] = {}
    for row in flagged:
        units.setdefault(row["unit"], []).append(condition_label(row["condition"]))
    return ", ".join(f"{unit} ({', '.join(conditions)})" for unit, conditions in units.items())


def _score(found: Mapping[tuple[str, str], Mapping[str, Any]], unit: str, condition: str) -> float:
    score = found.get((unit, condition), {}).get("score")
    return float("-inf") if score is None else float(score)


def _cell(row: Mapping[str, Any] | None) -> Cell:
    if row is None:
        return Cell("–")
    return Cell(number(row["score"]), strong=row["outlier"], note="flagged" if row["outlier"] else "")
