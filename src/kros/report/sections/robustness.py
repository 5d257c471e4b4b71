"""What observers do when measurements are worse than in the recordings, and on machines that the certificate covers but nobody has built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...evaluate import Kind, severity_of_growth
from ..content import Cell, Section, Table
from ..disturbances import AXES, Curves, curves, severity_text
from ..names import condition_label, number, observer_label
from ..run_folder import RunFolder

_TEXT = (
    "Recordings are made with care; machines in the field lose samples, are badly calibrated, or have a cheaper encoder. Here the measurements of "
    "held-out episodes are made worse in one way at a time, and nobody tells the observers."
)
_MEMBERS = (
    "A worst case is a bound. Random members of the set show what is typical in it, and how close the bound is: they stand exactly where the certificate "
    "puts them, in the study's form between its weights."
)


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return curves, doubling severities and Monte Carlo; None where the study ran nothing of it."""
    rows, found = metrics.get("robustness", []), metrics.get("monte_carlo", {})
    if not rows and not found:
        return None
    deployed, home = metrics["study"].get("deployed"), metrics["study"]["identify_on"]
    sets, noise = found.get("sets", []), found.get("noise", [])
    paragraphs = [*([_TEXT] if rows else []), *([_MEMBERS] if sets else []), *_exceeded(sets)]
    tables = [t for t in (_doubling(rows, home, run.measured_states, deployed), _sets(sets, deployed), _noise(noise, deployed)) if t]
    figures = [*(["robustness"] if rows else []), *(["members"] if sets else [])]
    more = [("The second state that is not measured", ["robustness_second"])] if rows else []
    return Section("robustness", "Robust against what", paragraphs, tables, figures, more=more)


def _exceeded(sets: Sequence[Mapping[str, Any]]) -> list[str]:
    beyond = [observer_label(row["observer"]) for row in sets if row["exceeded"]]
    return (
        [f"A member of the set exceeds the certified bound of {', '.join(beyond)}: the certificate is wrong; please report it."]
        if beyond
        else []
    )


def _doubling(rows: Sequence[Mapping[str, Any]], condition: str, measured: Sequence[str], deployed: str | None) -> Table | None:
    if not rows:
        return None
    found = curves(rows, condition)
    kinds = [kind for kind in Kind if any(kind in c for c in found.values())]
    cells = [[Cell(observer_label(name)), *(Cell(_doubled(found, name, kind, measured)) for kind in kinds)] for name in found]
    where = condition_label(condition)
    caption = (
        f"Severity at which the error doubles, {where}: geometric mean over the states that are not measured. A dash: not within what was tried. "
        "Gaps take a tenth of the time."
    )
    emphasised = [i for i, name in enumerate(found) if name == deployed]
    return Table(["observer", *(AXES[kind].title for kind in kinds)], cells, caption, emphasised=emphasised)


def _doubled(found: Curves, name: str, kind: Kind, measured: Sequence[str]) -> str:
    by_channel = found[name].get(kind, {})
    hidden = [c for c in by_channel if c not in measured] or list(by_channel)
    if not hidden:
        return "–"
    with np.errstate(divide="ignore"):
        errors = np.exp(np.mean([np.log(by_channel[c].errors) for c in hidden], axis=0))
    severities = by_channel[hidden[0]].severities
    return severity_text(kind, severity_of_growth(severities, errors), float(severities[1]))


def _sets(sets: Sequence[Mapping[str, Any]], deployed: str | None) -> Table | None:
    if not sets:
        return None
    rows = [
        [
            Cell(observer_label(row["observer"])),
            Cell(number(row["bound"], 4)),
            Cell(number(row["largest"], 4), strong=row["exceeded"]),
            *(Cell(number(row[key], 4)) for key in ("unit_worst", "unit_median")),
            Cell(number(row["quantiles"]["0.5"], 4)),
            Cell(number(row["noise"], 4)),
        ]
        for row in sets
    ]
    head = [
        "observer",
        "certified bound",
        f"largest of {sets[0]['members']} members",
        "worst unit",
        "median unit",
        "median member",
        "noise alone",
    ]
    caption = "H2 norm of the error, every channel over its largest value, noise included. The largest member is computed again by a Lyapunov equation."
    return Table(head, rows, caption, emphasised=[i for i, row in enumerate(sets) if row["observer"] == deployed])


def _noise(rows: Sequence[Mapping[str, Any]], deployed: str | None) -> Table | None:
    if not rows:
        return None
    cells = [
        [
            Cell(observer_label(row["observer"])),
            Cell(row["channel"].replace("_", " ")),
            Cell(number(row["error_percent"])),
            *(
                Cell("–" if row[key] is None else f"{number(row[key][0])} – {number(row[key][1])}")
                for key in ("over_noise", "over_units", "over_both")
            ),
        ]
        for row in rows
    ]
    caption = (
        f"Mean error in percent of the largest value over {rows[0]['units']} units with fresh measurement noise of the assumed level, on top of the "
        "recordings' own, and its 95 % intervals: over the noise alone, over the units alone, over both."
    )
    emphasised = [i for i, row in enumerate(rows) if row["observer"] == deployed]
    return Table(
        ["observer", "channel", "error", "over noise", "over units", "over both"], cells, caption, folded=True, emphasised=emphasised
    )
