"""Errors of observers on held-out episodes: in the condition of the models, in others, on units left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ...design.task import split_name
from ..content import Column, Section, Table, build
from ..error_tables import ErrorCell, ErrorTable, tables_of
from ..facts import Facts
from ..names import condition_label, in_condition, joined, label_of, number, observer_label, published, words

Rows = Sequence[tuple[ErrorTable, str]]
_TEXT = (
    "RMS errors on held-out episodes: in percent of the largest value of the signal, mean over the units other than "
    "the nominal one, and the worst of them; and in the channel's unit of measure."
)
_TRUE = "The estimate has the same lag as the recorded signal; errors against the true signal include it."


def errors(facts: Facts) -> Section | None:
    """Return the observers that are compared first, and the table of all observers in all conditions."""
    tables = facts.tables
    if not tables:
        return None
    roles = _compared(facts)
    notes = ["; ".join(filter(None, (joined(role), label_of(name).about))) for name, role in roles.items()]
    about = [Column("observer", [observer_label(n) for n in roles], notes=notes)]
    caption = f"Observers to compare{in_condition(tables[0].condition)}"
    first = _table(caption, about, [(tables[0], name) for name in roles], facts)
    every = [(table, name) for table in tables for name in table.cells]
    about = [
        Column("observer", [observer_label(name) for _, name in every], notes=[name for _, name in every]),
        Column("condition", [condition_label(table.condition) for table, _ in every]),
    ]
    caption = f"All {len(tables[0].cells)} observers in all conditions; small: 95 % interval of the mean over units"
    whole = _table(caption, about, every, facts, folded=True, sortable=True)
    more = [_TRUE] if any("true_rms" in r for r in facts.get("evaluation")) else []
    return Section("errors", "Errors", [" ".join([_TEXT, *more])], tables=[first, whole], figure="observers_in_time")


def other_conditions(facts: Facts) -> Section | None:
    """Return what the estimates are like in conditions that no model has seen; None where there is one condition."""
    if len(facts.tables) < 2:
        return None
    designed = f"Models, weights and observers are designed in “{condition_label(facts.study['identify_on'])}” alone"
    figure = "load_torque" if facts.get("load_torque") else "loaded_paper"
    text = f"{designed}; their errors in all conditions are in the table of all observers."
    return Section("other-conditions", "Other conditions", [text], figure=figure)


def left_out(facts: Facts) -> Section | None:
    """Return errors on units that took no part in the design; None where no unit was left out."""
    folded = facts.get("left_out")
    if not folded or not folded["rows"]:
        return None
    folds = len(folded["folds"])
    text = (
        f"The units are divided into {folds} folds. For each fold the study is repeated with all other units, and its "
        "observers run on the units of the fold, as on new units. Certified: in how many folds."
    )
    failed = [f"Fold {int(n) + 1} failed: {reason}" for n, reason in folded["failed"].items()]
    tables = []
    for table in tables_of(folded["rows"], facts.study["identify_on"]):
        entries = [folded["observers"].get(name, {}) for name in table.cells]
        parts = {"made": ("designed", ""), "robust": ("set of plants", "certified")}
        parts["relift_certified"] = ("at run time", "certified")
        about = [Column("observer", [observer_label(name) for name in table.cells])]
        for key, (title, group) in parts.items():
            counts = [None if e.get(key) is None else f"{e[key]}/{folds}" for e in entries]
            about.append(Column(title, counts, group))
        caption = f"Units left out{in_condition(table.condition)}"
        tables.append(_table(caption, about, [(table, name) for name in table.cells], facts, sortable=True))
    return Section("left-out", "Units left out", [text, *failed], tables=tables)


def _table(caption: str, about: Sequence[Column], rows: Rows, facts: Facts, **options: bool) -> Table | None:
    """Return errors of all hidden channels, a row an observer and condition."""
    channels = dict.fromkeys(c for table, _ in rows for c in table.hidden(facts.measured))
    columns = [column for c in channels for column in _channel(c, facts.unit(c), rows, bool(options))]
    return build(caption, [*about, *columns], facts.label, **options)


def _channel(channel: str, unit: str, rows: Rows, details: bool) -> list[Column]:
    """Return the columns of one channel; `details` are intervals."""
    cells = [table.cells[name].get(channel, ErrorCell()) for table, name in rows]
    group = words(channel)
    intervals = ["–".join(number(v, 2) for v in c.interval) if c.interval and details else "" for c in cells]
    means = ["diverged" if c.diverged else c.mean for c in cells]
    lags = [c.means.get("true_lag_s") for c in cells]
    return [
        Column("mean (%)", means, group, best=True, notes=intervals),
        Column("worst (%)", [c.worst for c in cells], group, best=True),
        Column(f"RMS ({unit})" if unit else "RMS", [c.means.get("rms") for c in cells], group),
        Column("against the true signal (%)", [c.means.get("true_error_percent") for c in cells], group),
        Column("lag (ms)", [None if lag is None else 1e3 * lag for lag in lags], group),
    ]


def _compared(facts: Facts) -> Mapping[str, Sequence[str]]:
    """Return the few observers that answer most questions, each with the roles it is compared in."""
    table, entries = facts.tables[0], facts.observers
    channels = table.hidden(facts.measured)
    designed = [n for n in table.cells if not label_of(n).baseline]
    certified = [n for n in designed if entries.get(n, {}).get("worst_case_h2") is not None]
    certified = certified or [n for n in designed if entries.get(n, {}).get("set_certified")]
    tuned = [n for n in table.cells if split_name(n)[1] == "kalman_tuned"]

    def best(names: Sequence[str]) -> str | None:
        return min(names, key=lambda name: table.mean(name, channels), default=None)

    chosen = [
        ("deployed", facts.deployed),
        ("best with a certificate", best(certified)),
        ("as published", next(iter(published(table.cells)), None)),
        *(("", name) for name in (best(tuned), "learned", "filtered_difference", f"{facts.model}/open_loop")),
    ]
    roles = dict[str, list[str]]()
    for role, name in chosen:
        if name in table.cells:
            roles.setdefault(str(name), []).extend([role] if role else [])
    return roles
