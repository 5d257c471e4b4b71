"""Errors of observers on held-out episodes: in the condition of the models, in others, on units left out."""

from collections.abc import Mapping, Sequence

from ..content import Column, Row, Section, Table, build
from ..facts import ErrorTable, Facts
from ..names import condition_label, in_condition, joined, label_of, number, observer_label, published, words

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
    about = [Column("observer", note="note")]
    notes = {n: "; ".join(filter(None, (joined(of), label_of(n).about))) for n, of in _compared(facts).items()}
    rows = [_row(tables[0], name) | {"note": note} for name, note in notes.items()]
    first = _table(f"Observers to compare{in_condition(tables[0].condition)}", about, tables[:1], rows, facts)
    caption = f"All {len(tables[0].cells)} observers in all conditions; small: 95 % interval of the mean over units"
    rows = [_row(table, name) | {"note": name} for table in tables for name in table.cells]
    whole = _table(caption, [*about, Column("condition")], tables, rows, facts, folded=True, sortable=True)
    more = [_TRUE] if any("true_rms" in r for r in facts.get("evaluation")) else []
    return Section("errors", "Errors", [_TEXT, *more], tables=[first, whole], figure="observers_in_time")


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
    about = [Column("observer"), Column("designed", "made"), Column("set of plants", "robust", "certified")]
    about += [Column("at run time", "relift_certified", "certified")]
    counts = {
        name: {key: f"{n}/{folds}" for key, n in entry.items() if isinstance(n, int)}
        for name, entry in folded["observers"].items()
    }
    tables = []
    for table in facts.tables_of(folded["rows"]):
        rows = [_row(table, name) | counts.get(name, {}) for name in table.cells]
        caption = f"Units left out{in_condition(table.condition)}"
        tables.append(_table(caption, about, [table], rows, facts, sortable=True))
    return Section("left-out", "Units left out", [text], tables=tables)


def _row(table: ErrorTable, name: str) -> Row:
    """Return the errors of an observer in one condition, by channel and what they are."""
    row: Row = {"observer": observer_label(name), "condition": condition_label(table.condition)}
    for channel, cell in table.cells[name].items():
        interval, lag_s = "–".join(number(v, 2) for v in cell.interval), cell.means.get("true_lag_s")
        known = {
            "mean": cell.shown,
            "worst": cell.worst,
            "interval": interval,
            **cell.means,
            "lag": lag_s and 1e3 * lag_s,
        }
        row |= {(channel, key): value for key, value in known.items()}
    return row


def _table(
    caption: str,
    about: Sequence[Column],
    tables: Sequence[ErrorTable],
    rows: Sequence[Row],
    facts: Facts,
    **options: bool,
) -> Table | None:
    """Return errors of all hidden channels, a row an observer and condition."""
    columns = list(about)
    for channel in dict.fromkeys(c for table in tables for c in table.hidden):
        unit = facts.unit(channel)
        titles = {
            "mean": "mean (%)",
            "worst": "worst (%)",
            "rms": f"RMS ({unit})" if unit else "RMS",
            "true_error_percent": "against the true signal (%)",
            "lag": "lag (ms)",
        }
        for key, title in titles.items():
            note = (channel, "interval") if key == "mean" and options else ""
            columns.append(Column(title, (channel, key), words(channel), best=key in ("mean", "worst"), note=note))
    return build(caption, columns, rows, facts.label, **options)


def _compared(facts: Facts) -> Mapping[str, Sequence[str]]:
    """Return the few observers that answer most questions, each with the roles it is compared in."""
    table, entries = facts.tables[0], facts.observers
    designed = [n for n in table.cells if not label_of(n).baseline]
    certified = [n for n in designed if entries.get(n, {}).get("worst_case_h2") is not None]
    certified = certified or [n for n in designed if entries.get(n, {}).get("set_certified")]
    chosen = [
        ("deployed", facts.deployed),
        ("best with a certificate", min(certified, key=lambda name: table.mean(name, table.hidden), default=None)),
        ("as published", next(iter(published(table.cells)), None)),
    ]
    rivals = f"{facts.model}/kalman_tuned", "learned", "filtered_difference", f"{facts.model}/open_loop"
    chosen += [("", name) for name in rivals]
    roles = dict[str, list[str]]()
    for role, name in chosen:
        if name in table.cells:
            roles.setdefault(str(name), []).extend([role] if role else [])
    return roles
