"""What observers do when measurements are worse than in the recordings, and on machines that the certificate covers but nobody has built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ...evaluate import Kind
from ..content import Cell, Cells, Section, Table, where
from ..disturbances import AXES, Curve, curves, doubling, severity_text
from ..names import in_condition, number, observer_label
from ..run_folder import RunFolder

Rows = Sequence[Mapping[str, Any]]
_TEXT = (
    "Recordings are made with care; machines in the field lose samples, are badly calibrated, or have a cheaper encoder. Here the measurements of "
    "held-out episodes are disturbed in one way at a time, beyond the sensor that is declared, and the observers are not informed."
)
_MEMBERS = (
    "A worst case is a bound. Random members of the set show what is typical in it, and how close the bound is: they enter at the uncertainty location of the "
    "certificate, in the study's form between its weights."
)


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return curves, doubling severities and Monte Carlo; None where the study ran nothing of it."""
    rows, found = metrics.get("robustness", []), metrics.get("monte_carlo", {})
    if not rows and not found:
        return None
    deployed, sets, noise = metrics["study"].get("deployed"), found.get("sets", []), found.get("noise", [])
    beyond = ", ".join(observer_label(row["observer"]) for row in sets if row["exceeded"])
    wrong = f"A member of the set exceeds the certified bound of {beyond}: the certificate is wrong; please report it."
    paragraphs = [*([_TEXT] if rows else []), *([_MEMBERS] if sets else []), *([wrong] if beyond else [])]
    tables = [
        *([_doubling(rows, metrics["study"]["identify_on"], run.measured_states, deployed)] if rows else []),
        *([_sets(sets, deployed)] if sets else []),
        *([_noise(noise, deployed)] if noise else []),
    ]
    figures = [*(["robustness"] if rows else []), *(["members"] if sets else [])]
    return Section("robustness", "Robustness", paragraphs, tables, figures)


def _doubling(rows: Rows, condition: str, measured: Sequence[str], deployed: str | None) -> Table:
    found = curves(rows, condition)
    kinds = [kind for kind in Kind if any(kind in c for c in found.values())]
    cells = [[observer_label(name), *(_doubled(kind, own.get(kind, {}), measured) for kind in kinds)] for name, own in found.items()]
    caption = (
        f"Severity at which the error doubles{in_condition(condition)}: geometric mean over the states that are not measured. A dash: not within what "
        "was tried. Gaps take a tenth of the time."
    )
    return Table(["observer", *(AXES[kind].title for kind in kinds)], cells, caption, emphasised=where(found, deployed))


def _doubled(kind: Kind, by_channel: Mapping[str, Curve], measured: Sequence[str]) -> str:
    found = doubling(kind, by_channel, measured)
    return "–" if found is None else severity_text(kind, *found)


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


def _noise(rows: Rows, deployed: str | None) -> Table:
    cells = [
        [
            *(observer_label(row["observer"]), row["channel"].replace("_", " "), number(row["error_percent"])),
            *("–" if row[key] is None else " – ".join(map(number, row[key])) for key in ("over_noise", "over_units", "over_both")),
        ]
        for row in rows
    ]
    caption = (
        f"Mean error in percent of the largest value over {rows[0]['units']} units with fresh measurement noise of the assumed level, on top of what "
        "the sensor shows, and its 95 % intervals: over the noise alone, over the units alone, over both."
    )
    head = ["observer", "channel", "error", "over noise", "over units", "over both"]
    return Table(head, cells, caption, folded=True, emphasised=where((row["observer"] for row in rows), deployed))
