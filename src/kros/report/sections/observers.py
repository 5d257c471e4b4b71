"""Errors of the observers where they were designed for and elsewhere: six to compare, all others behind them, and what they do in time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..content import Cell, Section, Table, where
from ..error_tables import ErrorCell, ErrorTable, error_table
from ..names import (
    axis_label,
    channel_units,
    condition_label,
    in_condition,
    joined,
    number,
    observer_label,
    paper_pair,
    split_observer,
)
from ..run_folder import RunFolder
from ..trust import best_certified, mean_error, trusts

_RECORDED = "as recorded"


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the observers that are compared first, and the table of all in all conditions; None where none was evaluated."""
    tables = error_table(metrics.get("evaluation", []), metrics["study"]["identify_on"])
    if not tables:
        return None
    text = (
        "RMS error on held-out episodes that nothing was fitted to, in the channel's unit of measure and in percent of the largest value of the signal in the "
        "episode: mean over the units other than the nominal one, and the worst of them. What “plants” and “signals” certify stands under Trust."
    )
    six = _compared(tables[0], metrics, run.measured_states)
    rows = [
        [
            Cell(joined(roles), note="" if observer_label(name) in roles else observer_label(name)),
            *_errors(tables[0], name, metrics, run.measured_states),
        ]
        for name, roles in six.items()
    ]
    deployed = metrics["study"].get("deployed")
    first = Table(
        ["observer", *_head(tables[0], metrics, run.measured_states)],
        rows,
        f"Observers to compare{in_condition(tables[0].condition)}",
        [("", 1), *_groups(tables[0], run.measured_states)],
        emphasised=where(six, deployed),
    )
    notes = baseline_notes(metrics.get("observers", {}))
    every = _all(tables, metrics, run.measured_states)
    return Section("observers", "Observers", [text], [first, every], ["observers_in_time"], notes=notes)


def estimates(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the figures of errors, estimates and their spectra, and errors against what the states really were."""
    if not metrics.get("evaluation"):
        return None
    text = (
        "The observers as they run: at every step the estimate is cut back to the original states and re-lifted with the unit's own parameters. An estimate "
        "for the next sample uses data up to this one."
    )
    figures = ["observers_in_time_paper", "observer_spectra"]
    return Section("estimates", "Estimates", [text], _against_truth(metrics), figures)


def baseline_notes(observers: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return what has to be known of baselines to compare with them: which correct nothing, what was trained on how much, what there is none of."""
    off = [observer_label(name) for name, facts in observers.items() if facts.get("correction_off")]
    notes = (
        [
            f"Tuning switched the correction off, no gain was better than the model alone on training episodes: {', '.join(off)}."
        ]
        if off
        else []
    )
    learned = observers.get("learned", {})
    if "episodes_recorded" in learned:
        part = "all" if learned["episodes"] == learned["episodes_recorded"] else f"{learned['episodes']} of"
        notes.append(
            f"The learned estimator was trained on {part} {learned['episodes_recorded']} training episodes, from their first sample on."
        )
    missing = [
        facts["reason"]
        for name, facts in observers.items()
        if name == "mean_profile" and facts.get("status") == "failed"
    ]
    return [*notes, *missing]


def _compared(table: ErrorTable, metrics: Mapping[str, Any], measured: Sequence[str]) -> dict[str, list[str]]:
    """Return the few observers that answer most questions, each with the roles it is compared in."""
    deployed, channels = metrics["study"].get("deployed"), table.hidden(measured)

    def tuned() -> str | None:
        names = [n for n in table.cells if split_observer(n)[1] == "kalman_tuned"]
        own = f"{split_observer(deployed or '')[0]}/kalman_tuned"
        return own if own in names else min(names, key=lambda n: mean_error(table, n, channels), default=None)

    chosen = [
        ("deployed", deployed),
        ("best that is certified for the set", best_certified(metrics, table, channels)),
        ("the paper's", next(iter(paper_pair(table.cells)[::-1]), None)),
        ("tuned Kalman", tuned()),
        ("learned", "learned"),
        ("filtered difference", "filtered_difference"),
    ]
    found: dict[str, list[str]] = {}
    for role, name in chosen:
        if name in table.cells:
            found.setdefault(str(name), []).append(role)
    return found


def _all(tables: Sequence[ErrorTable], metrics: Mapping[str, Any], measured: Sequence[str]) -> Table:
    """All observers in all conditions, a row each."""
    pairs = [(table, name) for table in tables for name in table.cells]
    rows = [
        [observer_label(name), condition_label(t.condition), *_errors(t, name, metrics, measured, interval=True)]
        for t, name in pairs
    ]
    caption = f"All {len(trusts(metrics))} observers in every condition: sort by any column, filter by words. Mean with its 95 % interval over units."
    if any(len(table.ranked) < len(table.channels) for table in tables):
        caption += " The current's error under load is the load's torque itself: reported, not ranked."
    head = ["observer", "condition", *_head(tables[0], metrics, measured)]
    chosen = where((name for _, name in pairs), metrics["study"].get("deployed"))
    return Table(
        head, rows, caption, [("", 2), *_groups(tables[0], measured)], folded=True, emphasised=chosen, sortable=True
    )


def _head(table: ErrorTable, metrics: Mapping[str, Any], measured: Sequence[str]) -> list[str]:
    units = channel_units(metrics)
    of_channels = [
        title
        for c in table.hidden(measured)
        for title in (axis_label("RMS", units.get(c, "")), "mean (%)", "worst (%)")
    ]
    return [*of_channels, "for the set", "as it runs"]


def _groups(table: ErrorTable, measured: Sequence[str]) -> list[tuple[str, int]]:
    return [*((c.replace("_", " "), 3) for c in table.hidden(measured)), ("certified", 2)]


def _errors(
    table: ErrorTable, name: str, metrics: Mapping[str, Any], measured: Sequence[str], interval: bool = False
) -> list[Cell | str]:
    trust = trusts(metrics)[name]
    channels = [cell for c in table.hidden(measured) for cell in _cells(table, c, table.cells[name].get(c), interval)]
    return [*channels, trust.by_set, trust.as_it_runs.partition(",")[0]]


def _cells(table: ErrorTable, channel: str, cell: ErrorCell | None, interval: bool) -> list[Cell | str]:
    if cell is None:
        return ["–"] * 3
    if cell.mean is None:
        return ["–", Cell("diverged", note=f"{cell.diverged} units"), "–"]
    note = f"{number(cell.interval[0], 2)}–{number(cell.interval[1], 2)}" if interval and cell.interval else ""
    mean, worst = (getattr(cell, what) for what in ("mean", "worst"))
    return [
        Cell(number(cell.rms), value=cell.rms),
        Cell(number(mean), strong=mean == table.best(channel, "mean"), note=note, value=mean),
        Cell(
            number(worst),
            strong=worst == table.best(channel, "worst"),
            note="" if interval else cell.worst_unit or "",
            value=worst,
        ),
    ]


def _against_truth(metrics: Mapping[str, Any]) -> list[Table]:
    """Errors and lag against what the states really were, of the recording itself and of all observers; none where the recordings do not say."""
    recorded = [{"observer": _RECORDED, **r} for r in metrics.get("recorded", [])]
    rows = [r for r in [*recorded, *metrics["evaluation"]] if "true_rms" in r and r["role"] != "outlier"]
    places, observers = (
        dict.fromkeys((r["channel"], r["condition"]) for r in rows),
        tuple(dict.fromkeys(r["observer"] for r in rows)),
    )
    if not rows:
        return []
    found: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for r in rows:
        found.setdefault((r["observer"], r["channel"], r["condition"]), []).append(r)
    body = [
        [observer_label(o), *(cell for place in places for cell in _true_cells(found.get((o, *place), [])))]
        for o in observers
    ]
    groups = [("", 1), *((f"{channel.replace('_', ' ')}{in_condition(condition)}", 3) for channel, condition in places)]
    caption = (
        "Against what the states really were, which the simulation or a better sensor knows: RMS error in percent of the largest true value, mean over the "
        "units and worst unit, and how late the signal is in the mean, by the delay that fits best. An observer made to agree with a recording that trails "
        "trails as well."
    )
    deployed = where(observers, metrics["study"].get("deployed"))
    return [
        Table(
            ["observer", *("mean", "worst", "lag (ms)") * len(places)],
            body,
            caption,
            groups,
            folded=True,
            emphasised=deployed,
            sortable=True,
        )
    ]


def _true_cells(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    errors, lags = ([r[f"true_{what}"] for r in rows] for what in ("error_percent", "lag_s"))
    if not rows or None in errors:
        return ["–" if not rows else "diverged", "–", "–"]
    lag = None if None in lags else 1e3 * sum(lags) / len(lags)
    return [number(sum(errors) / len(errors)), number(max(errors)), number(lag)]
