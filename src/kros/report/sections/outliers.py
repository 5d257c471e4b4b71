"""Units that do not belong to the batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..content import Section
from ..figures.residuals import Names, entry_names, short
from ..names import condition_label, number
from ..run_folder import NotShownError, RunFolder

_NAMED = 100
_MEANING = (
    "Beside every score stands the smallest change that would have been flagged: what the unit would have to exceed the others by, and the smallest change of "
    "gain in one response that does so somewhere. A unit that is “ok” may have any defect that changes its responses by less."
)


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return how scores are made, and where flagged units differ; None where none were computed."""
    rows = metrics.get("outliers")
    if not rows:
        return None
    text = (
        "A unit's score is by how much its largest residual, relative to the typical size at its frequency, exceeds the largest of all the others. "
        "Scores look at the recordings only, never at serial or group. Some unit always has the highest score, so there is a threshold; above it a unit is "
        "flagged."
    )
    flagged = [score_card(row, score_names(run, row["condition"])) for row in rows if row["outlier"]][:_NAMED]
    return Section(
        "outliers", "Outliers", [text, *undecided_text(rows), _MEANING, *flagged], figures=["outlier_scores"]
    )


def undecided_text(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return about which units the scores say nothing, and why; nothing where there are none."""
    texts = []
    for status, why in (
        ("not enough data", "too little was recorded of it"),
        ("cannot tell", "the others are fewer than eight, or too unlike"),
    ):
        silent = [r for r in rows if r.get("status") == status]
        if silent:
            texts.append(
                f"{len(silent)} of {len(rows)} scores say nothing about their unit, as {why}: {flagged_text(silent)}."
            )
    return texts


def score_text(row: Mapping[str, Any], names: Names | None) -> str:
    """Say where and how clearly a flagged unit exceeds the others."""
    text = f"Unit {row['unit']} ({condition_label(row['condition'])}) scores {number(row['score'])} dB"
    if row.get("freq_hz") is None:
        return f"{text}."
    text += f", most at {number(row['freq_hz'])} Hz{_entry(row, names, ' in the response of {0} to {1}')}"
    if row.get("lowest_db") is not None:
        which = (
            "every choice" if row["lowest_db"] > 0 else "some choices only" if row["highest_db"] > 0 else "no choice"
        )
        text += f". It exceeds the others under {which} of the nominal, by {number(row['lowest_db'])} to {number(row['highest_db'])} dB"
        text += f"; with {100 * row['agreement']:.0f} % of these nominals alone it would be flagged"
    return f"{text}."


def _entry(row: Mapping[str, Any], names: Names | None, pattern: str) -> str:
    """Name the entry of the residual that is largest, with its row and column."""
    if names is None or row.get("entry") is None:
        return ""
    i, j = row["entry"]
    return pattern.format(short(names[0][i]), short(names[1][j]))


def score_names(run: RunFolder, condition: str) -> Names | None:
    """Signals behind the entries of the residuals that units are scored by; None where the run does not know."""
    try:
        model = run.outlier_models[condition]
        return entry_names(
            model.form, next(m for n, m in run.models.items() if m.lifting.n_lifted == len(model.output_scale))
        )
    except (NotShownError, KeyError, StopIteration):
        return None


def flagged_text(flagged: list[Mapping[str, Any]]) -> str:
    """Return flagged units with their conditions, for a sentence."""
    units: dict[str, list[str]] = {}
    for row in flagged:
        units.setdefault(row["unit"], []).append(condition_label(row["condition"]))
    return some_of([f"{unit} ({', '.join(conditions)})" for unit, conditions in units.items()])


def some_of(names: Sequence[str]) -> str:
    """Return names for a sentence, the first hundred of many."""
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")


def score_card(row: Mapping[str, Any], names: Names | None) -> str:
    """Return all that is known about a score."""
    text = f"{score_text(row, names)} Status: {row.get('status', 'outlier' if row['outlier'] else 'ok')}."
    if row.get("detectable_db") is None or row.get("detectable") is None:
        return text
    return f"{text} Flagged from {number(row['detectable_db'])} dB on, a change of gain by {number(row['detectable'], 2)} % in one response."
