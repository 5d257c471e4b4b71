"""Runs beside each other: settings and data in which they differ, and what they lead to, from settings and metrics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..core import ByName, Record
from .content import Column, Section, build
from .facts import Facts
from .names import number
from .verdict import judge

_WORDS = ("settings", "data", "deployed")  # topics whose values are texts
TITLES = {
    "settings": "Settings that differ",
    "data": "Recordings",
    "deployed": "Deployed observer",
    "errors": "Errors on held-out episodes, percent of the largest value",
    "weights": "Uncertain models",
    "certificates": "Certificates, bounds in percent of the largest value",
}


def comparison(runs: Mapping[str, tuple[ByName, Facts]]) -> dict[str, dict[str, list[Any]]]:
    """Return what is compared: by topic, and by name a value of every run, None where a run has none.

    Parameters
    ----------
    runs : mapping of str to (mapping, Facts)
        ByName and metrics of every run.
    """
    settings, facts = [dict(flat(study)) for study, _ in runs.values()], [of for _, of in runs.values()]
    compared = {name: values for name, values in side_by_side(settings).items() if len(set(values)) > 1}
    topics = data, deployed, errors, weights, certificates
    return {"settings": compared, **{topic.__name__: side_by_side([topic(of) for of in facts]) for topic in topics}}


def side_by_side(of_runs: Sequence[Record]) -> dict[str, list[Any]]:
    """Return a value of every run by name, without names that no run knows."""
    names = dict.fromkeys(name for rows in of_runs for name, value in rows.items() if value not in (None, ""))
    return {name: [rows.get(name) for rows in of_runs] for name in names}


def sections(names: Sequence[str], compared: Mapping[str, Mapping[str, Sequence[Any]]]) -> list[Section]:
    """Return tables with a row for everything that is compared, and a column for every run."""
    found = []
    for topic, rows in compared.items():
        values = [[row[i] for row in rows.values()] for i in range(len(names))]
        changes = [change(row[0], row[-1]) for row in rows.values()]
        columns = [Column(name, column) for name, column in zip(names, values, strict=True)]
        table = build("", [Column("", list(rows)), *columns, Column("change", changes)], prose=topic in _WORDS)
        found.append(Section(topic, TITLES[topic], [] if table else ["Nothing differs."], tables=[table]))
    return [section for section in found if any(section.tables) or section.key == "settings"]


def change(first: Any, last: Any) -> str | None:
    """Return the change of a positive number in percent."""
    if not (isinstance(first, float) and isinstance(last, float) and first > 0):
        return None
    return f"{'+' if last >= first else ''}{number(100 * (last / first - 1))} %"


def flat(content: ByName, before: str = "") -> Iterator[tuple[str, str]]:
    """Yield all settings by dotted names, as text."""
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{before}{name}.")
        elif value is not None:
            yield f"{before}{name}", text(value)


def text(value: Any) -> str:
    """Return a setting as text."""
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def data(facts: Facts) -> Record:
    """Return what was recorded."""
    aside = sum(row.get("group") == "outliers" for row in facts.get("units", ()))
    study = {name: value for name, value in facts.study.items() if name not in ("deployed", "alerts")}
    return dict(flat(study | {"units_set_aside": aside}))


def deployed(facts: Facts) -> Record:
    """Return which observer is deployed, and what is said of it."""
    verdict = judge(facts)
    return {
        "name": facts.label,
        "verdict": verdict.status.value,
        "reasons": " ".join(reason.text for reason in verdict.reasons),
        "states": facts.entry.get("order"),
        "settles after (samples)": facts.entry.get("settle_samples"),
        "time of the study (s)": facts.get("timing_s", {}).get("total"),
    }


def errors(facts: Facts) -> Record:
    """Return mean and worst errors of all observers in the channels that are not measured."""
    rows = Record()
    for table in facts.tables:
        where = f", {table.condition}" if len(facts.tables) > 1 else ""
        for name, cells in table.cells.items():
            for channel in table.hidden(facts.measured, name):
                cell, what = cells[channel], f"{name}: {channel}{where}"
                rows |= {what: "diverged" if cell.diverged else cell.mean, f"{what}, worst unit": cell.worst}
    return rows


def weights(facts: Facts) -> Record:
    """Return form, nominal and weights of every kind of model."""
    rows = Record()
    for kind, found in facts.get("uncertainty", {}).items():
        weight = found.get("weight", {})
        rows |= {
            f"{kind}: form": found.get("form"),
            f"{kind}: nominal": found.get("nominal"),
            f"{kind}: orders": text(weight.get("orders", ())),
            f"{kind}: largest residual over weight": weight.get("cover_max"),
            f"{kind}: weight above the residuals (dB)": weight.get("overbound_db_max"),
            f"{kind}: peak (dB)": found.get("peak_db", {}).get(found.get("form")),
        }
    flagged = [f"{r['unit']} ({r['condition']})" for r in facts.get("outliers", ()) if r["outlier"]]
    return rows | ({"units flagged": text(flagged) or "none"} if rows else {})


def certificates(facts: Facts) -> Record:
    """Return bounds over the set of plants, worst-case H2 and gains at run time of all observers."""
    rows = Record()
    for name, entry in facts.observers.items():
        bounds = entry.get("set_bound_percent") or {}
        rows |= {f"{name}: {c}": bound for c, bound in bounds.items() if c not in facts.measured}
        rows |= {
            f"{name}: worst-case H2": entry.get("worst_case_h2"),
            f"{name}: gain at run time": entry.get("relift_gain"),
        }
    return rows


def lines(section: Section) -> list[str]:
    """Return the tables of a section for a terminal."""
    found = ["", section.title, *section.paragraphs]
    for table in filter(None, section.tables):
        rows = [list(table.head), *([cell.text for cell in row] for row in table.rows)]
        widths = [max(len(row[i]) for row in rows) for i in range(len(table.head))]
        found += [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
        ]
    return found
