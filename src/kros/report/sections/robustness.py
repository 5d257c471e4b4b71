"""What observers do when measurements are worse than in the recordings, and on machines that the certificate covers but nobody has built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..content import Cell, Cells, Section, Table, where
from ..names import number, observer_label
from ..run_folder import RunFolder

Rows = Sequence[Mapping[str, Any]]
_TEXT = (
    "Recordings are made with care; machines in the field lose samples, are badly calibrated, or have a cheaper encoder. Here the measurements of "
    "held-out episodes are disturbed in one way at a time, beyond the sensor that is declared, and the observers are not informed. "
    "Where errors double stands under Trust."
)
_MEMBERS = (
    "A worst case is a bound. Random members of the set show what is typical in it, and how close the bound is: they enter at the uncertainty location of the "
    "certificate, in the study's form between its weights."
)


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return curves and Monte Carlo; None where the study ran nothing of it."""
    rows, found = metrics.get("robustness", []), metrics.get("monte_carlo", {})
    if not rows and not found:
        return None
    sets = found.get("sets", [])
    paragraphs, figures = (
        [*([_TEXT] if rows else []), *([_MEMBERS] if sets else [])],
        ["robustness"] * bool(rows) + ["members"] * bool(sets),
    )
    return Section("robustness", "Robustness", paragraphs, [_sets(sets, metrics["study"].get("deployed"))] if sets else [], figures)


def _sets(sets: Rows, deployed: str | None) -> Table:
    rows: list[Cells] = [
        [
            *(observer_label(row["observer"]), number(row["bound"], 4), Cell(number(row["largest"], 4), strong=row["exceeded"])),
            *(number(value, 4) for value in (row["unit_worst"], row["unit_median"], row["quantiles"]["0.5"], row["noise"])),
        ]
        for row in sets
    ]
    largest = f"largest of {sets[0]['members']} members"
    head = ["observer", "certified bound", largest, "worst unit", "median unit", "median member", "noise alone"]
    caption = "H2 norm of the error, every channel over its largest value, noise included. The largest member is computed again by a Lyapunov equation."
    return Table(head, rows, caption, emphasised=where((row["observer"] for row in sets), deployed))
