"""Runs beside each other: settings and data in which they differ, and what they lead to, from settings and metrics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..core import ByName, Record
from .content import Column, Section, build
from .facts import Facts
from .names import number, words
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
_OF_MODELS = {"form": "form", "nominal": "nominal", "peak_db": "peak (dB)", "weight": "weight"}
_OF_OBSERVERS = {"set_bound_percent": "bound", "worst_case_h2": "worst-case H2", "relift_gain": "gain at run time"}


def comparison(runs: Mapping[str, tuple[ByName, Facts]]) -> dict[str, dict[str, list[Any]]]:
    """Return what is compared: by topic, and by name a value of every run, None where a run has none.

    Parameters
    ----------
    runs : mapping of str to (mapping, Facts)
        Settings and metrics of every run.
    """
    settings = side_by_side([texts(study) for study, _ in runs.values()])
    topics = data, deployed, errors, weights, certificates
    compared = {topic.__name__: side_by_side([topic(facts) for _, facts in runs.values()]) for topic in topics}
    return {"settings": {name: values for name, values in settings.items() if len(set(values)) > 1}, **compared}


def side_by_side(of_runs: Sequence[ByName]) -> dict[str, list[Any]]:
    """Return a value of every run by name, without names that no run knows."""
    names = dict.fromkeys(name for rows in of_runs for name, value in rows.items() if value not in (None, ""))
    return {name: [rows.get(name) for rows in of_runs] for name in names}


def sections(names: Sequence[str], compared: Mapping[str, Mapping[str, Sequence[Any]]]) -> list[Section]:
    """Return tables with a row for everything that is compared, and a column for every run."""
    shown = []
    for topic, rows in compared.items():
        columns = [Column(title, place) for place, title in enumerate(("", *names, "change"))]
        values = [dict(enumerate((name, *of, change(of[0], of[-1])))) for name, of in rows.items()]
        table = build("", columns, values, prose=topic in _WORDS)
        if table or topic == "settings":
            shown.append(Section(topic, TITLES[topic], [] if table else ["Nothing differs."], tables=[table]))
    return shown


def change(first: Any, last: Any) -> str | None:
    """Return the change of a positive number in percent."""
    if not (isinstance(first, float) and isinstance(last, float) and first > 0):
        return None
    return f"{'+' if last >= first else ''}{number(100 * (last / first - 1))} %"


def flat(content: ByName, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield all values that are known, by dotted names."""
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{before}{name}.")
        elif value is not None:
            yield f"{before}{name}", ", ".join(map(str, value)) if isinstance(value, list | tuple) else value


def texts(content: ByName) -> Record:
    """Return the same as texts."""
    return {name: str(value) for name, value in flat(content)}


def of_each(entries: Mapping[str, ByName], labels: ByName) -> Record:
    """Return some entries of all models, or all observers, by labels of their names in the metrics."""
    rows = Record()
    for name, entry in entries.items():
        for key, value in flat(entry):
            first, *rest = key.split(".")
            if first in labels:
                rows[f"{name}: {', '.join([labels[first], *map(words, rest)])}"] = value
    return rows


def data(facts: Facts) -> Record:
    """Return what was recorded."""
    study = {name: value for name, value in facts.study.items() if name not in ("deployed", "alerts")}
    return texts(study | {"units_set_aside": len(facts.set_aside)})


def deployed(facts: Facts) -> Record:
    """Return which observer is deployed, and what is said of it."""
    verdict = judge(facts)
    return {
        "name": facts.label,
        "verdict": verdict.status.value,
        "reasons": " ".join(reason.text for reason in verdict.reasons),
        "states": facts.entry.get("order"),
        "settles after (samples)": facts.entry.get("settle_samples"),
        "time of the study (s)": facts.get("timing_s").get("total"),
    }


def errors(facts: Facts) -> Record:
    """Return mean and worst errors of all observers in the channels that are not measured."""
    rows = Record()
    for table in facts.tables:
        where = f", {table.condition}" if len(facts.tables) > 1 else ""
        for name, cells in table.cells.items():
            for channel in table.hidden(name):
                what = f"{name}: {channel}{where}"
                rows |= {what: cells[channel].shown, f"{what}, worst unit": cells[channel].worst}
    return rows


def weights(facts: Facts) -> Record:
    """Return form, nominal and weights of every kind of model, and the units flagged."""
    rows = of_each(facts.get("uncertainty"), _OF_MODELS)
    flagged = [f"{r['unit']} ({r['condition']})" for r in facts.get("outliers") if r["outlier"]]
    return rows | ({"units flagged": ", ".join(flagged) or "none"} if rows else {})


def certificates(facts: Facts) -> Record:
    """Return bounds for recorded signals, worst-case H2 and gains at run time of all observers."""
    return of_each(facts.observers, _OF_OBSERVERS)


def lines(section: Section) -> list[str]:
    """Return the tables of a section for a terminal."""
    shown = ["", section.title, *section.paragraphs]
    for table in filter(None, section.tables):
        rows = [table.head, *([cell.text for cell in row] for row in table.rows)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        padded = ("  ".join(map(str.ljust, row, widths)) for row in rows)
        shown += [line.rstrip() for line in padded]
    return shown
