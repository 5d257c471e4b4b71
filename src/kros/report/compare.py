"""Runs beside each other: in which settings they differ, and in what these lead to, from settings and metrics."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..core import ByName, Record
from .facts import Facts
from .names import number
from .verdict import judge

_OF_MODELS = ("form", "nominal", "peak_db", "weight")
_OF_OBSERVERS = ("order", "settle_samples", "set_bound_percent", "worst_case_h2", "relift_gain")


def compared(study: ByName, facts: Facts) -> dict[str, ByName]:
    """Return what is compared of a run, by topic."""
    verdict, errors = judge(facts), Record()
    for table in facts.tables:
        for name, cells in table.cells.items():
            for channel in (c for c in table.hidden if c in cells):
                errors[f"{name}: {channel}, {table.condition}"] = cells[channel].shown
                errors[f"{name}: {channel}, {table.condition}, worst unit"] = cells[channel].worst
    return {
        "settings": study,
        "recordings": facts.study,
        "verdict": {"status": verdict.status.value, "points to check": len(verdict.reasons)},
        "errors in percent": errors,
        "models": _parts(facts.get("uncertainty"), _OF_MODELS),
        "observers": _parts(facts.observers, _OF_OBSERVERS),
        "time": facts.get("timing_s"),
    }


def _parts(entries: Mapping[str, ByName], keys: Sequence[str]) -> Record:
    return {name: {key: entry.get(key) for key in keys} for name, entry in entries.items()}


def differences(runs: Sequence[Mapping[str, ByName]]) -> dict[str, dict[str, list[Any]]]:
    """Return what differs: by topic, and by name a value of every run, None where a run has none."""
    differing = {}
    for topic in runs[0]:
        values = [dict(flat(run[topic])) for run in runs]
        rows = {name: [of.get(name) for of in values] for of_run in values for name in of_run}
        differing[topic] = {name: row for name, row in rows.items() if any(value != row[0] for value in row)}
    return differing


def flat(content: ByName, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield all values that are known, by dotted names."""
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{before}{name}.")
        elif value is not None:
            yield f"{before}{name}", ", ".join(map(str, value)) if isinstance(value, list | tuple) else value


def lines(names: Sequence[str], differing: Mapping[str, Mapping[str, Sequence[Any]]]) -> list[str]:
    """Return a table for every topic, with a row for everything that differs and a column for every run."""
    shown = []
    for topic, rows in differing.items():
        table = aligned([("", *names), *((name, *values) for name, values in rows.items())]) if rows else []
        shown += ["", topic if rows else f"{topic}: nothing differs", *table]
    return shown


def aligned(rows: Sequence[Sequence[Any]]) -> list[str]:
    """Return the rows of a table as lines for a terminal."""
    cells = [
        [number(value) if value is None or isinstance(value, float) else str(value) for value in row] for row in rows
    ]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in cells]
