"""Errors of observers on held-out episodes: in the condition of the models, in others, and on units that were left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..content import Column, Section, Table, build
from ..error_tables import PAPER, ErrorCell, ErrorTable, error_tables, left_out_tables
from ..names import (
    BASELINES,
    condition_label,
    in_condition,
    joined,
    number,
    observer_about,
    observer_label,
    paper_pair,
    readable_unit,
    split_observer,
    words,
)
from ..verdict import measured_of

Facts = Mapping[str, Any]
_TEXT = (
    "Errors on held-out episodes, RMS over time: in percent of the largest value of the signal, mean over the units other "
    "than the nominal one, and the worst of them; RMS in the channel's unit of measure. The estimate is compared with the "
    "recorded signal, and with the true signal where that is known. The estimate has the same lag as the recorded signal."
)


def errors(metrics: Facts) -> Section | None:
    """Return the observers that are compared first, and the table of all observers in all conditions."""
    tables = error_tables(metrics)
    if not tables:
        return None
    roles = _compared(tables[0], metrics)
    cells = [(tables[0], name) for name in roles]
    about = [Column("observer", [observer_label(n) for n in roles], notes=_notes(roles))]
    first = _table(f"Observers to compare{in_condition(tables[0].condition)}", about, cells, metrics)
    every = [(table, name) for table in tables for name in table.cells]
    about = [
        Column("observer", [observer_label(name) for _, name in every], notes=[name for _, name in every]),
        Column("condition", [condition_label(t.condition) for t, _ in every] if len(tables) > 1 else [""] * len(every)),
    ]
    caption = f"All {len(tables[0].cells)} observers in all conditions; small: 95 % interval of the mean over units"
    whole = _table(caption, about, every, metrics, folded=True, sortable=True)
    return Section("errors", "Errors", [_TEXT], tables=[first, whole], figure="observers_in_time")


def other_conditions(metrics: Facts) -> Section | None:
    """Return errors in conditions that no model has seen; None where there is one condition."""
    tables = error_tables(metrics)
    if len(tables) < 2:
        return None
    home = condition_label(metrics["study"]["identify_on"])
    text = f"Models, weights and observers are designed in “{home}”; here they run in other conditions."
    if any(len(table.ranked) < len(table.channels) for table in tables):
        text += " Under load the error of the current is the load torque itself, and is not ranked."
    shown = []
    for table in tables[1:]:
        names = [name for name in _compared(tables[0], metrics) if name in table.cells]
        about = [Column("observer", [observer_label(n) for n in names])]
        shown.append(_table(f"Errors{in_condition(table.condition)}", about, [(table, n) for n in names], metrics))
    figure = "load_torque" if metrics.get("load_torque") else "loaded_paper"
    return Section("other-conditions", "Other conditions", [text], tables=shown, figure=figure)


def left_out(metrics: Facts) -> Section | None:
    """Return errors on units that took no part in the design; None where no unit was left out."""
    facts = metrics.get("left_out")
    if not facts or not facts["rows"]:
        return None
    folds = len(facts["folds"])
    text = (
        f"The units are divided into {folds} folds. For each fold the whole study is repeated with all other units, and its "
        "observers run on the units of the fold, as on new machines. Certified: in how many folds."
    )
    failed = [f"Fold {int(n) + 1} failed: {reason}" for n, reason in facts["failed"].items()]
    tables = []
    for table in left_out_tables(facts["rows"], metrics["study"]["identify_on"]):
        own = [facts["observers"].get(name, {}) for name in table.cells]
        counts = {key: [_count(o.get(key), folds) for o in own] for key in ("robust", "relift_certified")}
        about = [
            Column("observer", [observer_label(name) for name in table.cells]),
            Column("designed", [_count(o.get("made"), folds) for o in own]),
            Column("set of plants", counts["robust"], "certified"),
            Column("at run time", counts["relift_certified"], "certified"),
        ]
        caption = f"Units left out{in_condition(table.condition)}; small: 95 % interval of the mean over units"
        if any(cell.band_db is not None for cells in table.cells.values() for cell in cells.values()):
            caption += f"; band: power at the gearbox frequency relative to “{observer_label(PAPER)}”"
        rows = [(table, name) for name in table.cells]
        tables.append(_table(caption, about, rows, metrics, sortable=True))
    return Section("left-out", "Units left out", [text, *failed], tables=tables)


def _count(value: int | None, folds: int) -> str | None:
    return None if value is None else f"{value}/{folds}"


def _table(
    caption: str,
    about: Sequence[Column],
    rows: Sequence[tuple[ErrorTable, str]],
    metrics: Facts,
    **options: bool,
) -> Table | None:
    """Return errors of all hidden channels, a row an observer and condition."""
    channels = list(dict.fromkeys(c for table, _ in rows for c in table.hidden(measured_of(metrics))))
    units = metrics["study"].get("channels", {})
    columns = [*about, *(column for c in channels for column in _channel(c, units.get(c, ""), rows, bool(options)))]
    deployed = metrics["study"].get("deployed")
    return build(caption, columns, observer_label(deployed) if deployed else None, **options)


def _channel(channel: str, unit: str, rows: Sequence[tuple[ErrorTable, str]], notes: bool) -> list[Column]:
    """Return the columns of one channel."""
    cells = [table.cells[name].get(channel, ErrorCell()) for table, name in rows]
    ranked = all(channel in table.ranked for table, _ in rows)
    intervals = [
        f"{number(c.interval[0], 2)}–{number(c.interval[1], 2)}" if c.interval and notes else "" for c in cells
    ]
    means = ["diverged" if c.diverged else c.mean for c in cells]
    lags = [None if c.lag_s is None else 1e3 * c.lag_s for c in cells]
    group = words(channel)
    return [
        Column("mean (%)", means, group, best=ranked, notes=intervals),
        Column("worst (%)", [c.worst for c in cells], group, best=ranked),
        Column(f"RMS ({readable_unit(unit)})" if readable_unit(unit) else "RMS", [c.rms for c in cells], group),
        Column("against the true signal (%)", [c.true_mean for c in cells], group),
        Column("lag (ms)", lags, group),
        Column("band (dB)", [c.band_db for c in cells] if notes else [None] * len(cells), group),
    ]


def _notes(roles: Mapping[str, Sequence[str]]) -> list[str]:
    """Return below every observer why it is compared, and what it is."""
    return ["; ".join(part for part in (joined(own), observer_about(name)) if part) for name, own in roles.items()]


def _compared(table: ErrorTable, metrics: Facts) -> dict[str, list[str]]:
    """Return the few observers that answer most questions, each with the roles it is compared in."""
    deployed, channels = metrics["study"].get("deployed"), table.hidden(measured_of(metrics))
    entries = metrics.get("observers", {})
    designed = [n for n in table.cells if split_observer(n)[1] not in BASELINES]
    certified = [n for n in designed if entries.get(n, {}).get("worst_case_h2") is not None]
    certified = certified or [n for n in designed if entries.get(n, {}).get("set_certified")]
    tuned = [n for n in table.cells if split_observer(n)[1] == "kalman_tuned"]

    def best(names: Sequence[str]) -> str | None:
        return min(names, key=lambda name: table.mean(name, channels), default=None)

    chosen = [
        ("deployed", deployed),
        ("best with a certificate", best(certified)),
        ("the paper's", next(iter(paper_pair(table.cells)[::-1]), None)),
        ("", best(tuned)),
        ("", "learned"),
        ("", "filtered_difference"),
        ("", f"{split_observer(deployed or '')[0]}/open_loop"),
    ]
    roles: dict[str, list[str]] = {}
    for role, name in chosen:
        if name in table.cells:
            roles.setdefault(str(name), []).extend([role] if role else [])
    return roles
