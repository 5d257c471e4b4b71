"""Errors of the observers where they were designed for: the result table, and what they do in time and frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..content import Cell, Section, Table, where
from ..error_tables import ErrorCell, ErrorTable, error_table
from ..names import axis_label, channel_units, in_condition, number, observer_label
from ..run_folder import RunFolder

_RECORDED = "as recorded"


def result(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the tables of all observers and channels, with the chart."""
    tables = error_table(metrics.get("evaluation", []), metrics["study"]["identify_on"])
    if not tables:
        return None
    text = (
        "RMS error on held-out episodes that nothing was fitted to, in percent of the largest absolute value of the signal in the episode. Off nominal: mean "
        "over the units other than the nominal one, with its 95 % interval by a bootstrap over these units, and the worst of them; RMS: the same mean in the "
        "channel's own unit of measure. Best of each column in bold; the deployed observer is set off."
    )
    notes = baseline_notes(metrics.get("observers", {}))
    shown = [_errors(t, metrics["study"].get("deployed"), run.measured_states, channel_units(metrics)) for t in tables]
    return Section("results", "Results", [text, *([" ".join(notes)] if notes else [])], [*shown, *_against_truth(metrics)], ["errors"])


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the figures of estimates and their spectra."""
    if not metrics.get("evaluation"):
        return None
    text = (
        "The observers as they run: at every step the estimate is cut back to the original states and re-lifted with the unit's own parameters. An estimate "
        "for the next sample uses data up to this one."
    )
    return Section("observers", "Estimates", [text], [], ["observers_in_time", "observers_in_time_paper", "observer_spectra"])


def baseline_notes(observers: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return what has to be known of baselines to compare with them: which correct nothing, what was trained on how much, what there is none of."""
    off = [observer_label(name) for name, facts in observers.items() if facts.get("correction_off")]
    notes = (
        [f"Tuning switched the correction off, no gain was better than the model alone on training episodes: {', '.join(off)}."]
        if off
        else []
    )
    learned = observers.get("learned", {})
    if "episodes_recorded" in learned:
        part = "all" if learned["episodes"] == learned["episodes_recorded"] else f"{learned['episodes']} of"
        notes.append(
            f"The learned estimator was trained on {part} {learned['episodes_recorded']} training episodes, from their first sample on."
        )
    missing = [facts["reason"] for name, facts in observers.items() if name == "mean_profile" and facts.get("status") == "failed"]
    return [*notes, *missing]


def _errors(table: ErrorTable, deployed: str | None, measured: tuple[str, ...], channel_units: Mapping[str, str]) -> Table:
    """One condition's errors, channels that are measured last."""
    channels = sorted(table.channels, key=lambda c: c in measured)
    rows = [
        [observer_label(o), *(cell for c in channels for cell in _cells(table, c, cells.get(c), c not in measured))]
        for o, cells in table.cells.items()
    ]
    head = ["observer", *(title for c in channels for title in ("nominal", "mean", "worst", axis_label("RMS", channel_units.get(c, ""))))]
    groups = [("", 1), *((c.replace("_", " ") + ("" if c in table.ranked else " (not ranked)"), 4) for c in channels)]
    caption = f"Errors in percent of the largest value, and as RMS in the channel's unit{in_condition(table.condition)}."
    if len(table.ranked) < len(table.channels):
        caption += " The current's error under load is the load's torque itself: reported, not ranked."
    return Table(head, rows, caption, groups, emphasised=where(table.cells, deployed))


def _against_truth(metrics: Mapping[str, Any]) -> list[Table]:
    """Errors and lag against what the states really were, of the recording itself and of all observers; none where the recordings do not say."""
    recorded = [{"observer": _RECORDED, **r} for r in metrics.get("recorded", [])]
    rows = [r for r in [*recorded, *metrics["evaluation"]] if "true_rms" in r and r["role"] != "outlier"]
    places, observers = dict.fromkeys((r["channel"], r["condition"]) for r in rows), tuple(dict.fromkeys(r["observer"] for r in rows))
    if not rows:
        return []
    found: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for r in rows:
        found.setdefault((r["observer"], r["channel"], r["condition"]), []).append(r)
    body = [[observer_label(o), *(cell for place in places for cell in _true_cells(found.get((o, *place), [])))] for o in observers]
    groups = [("", 1), *((f"{channel.replace('_', ' ')}{in_condition(condition)}", 3) for channel, condition in places)]
    caption = (
        "Against what the states really were, which the simulation or a better sensor knows: RMS error in percent of the largest true value, mean over the "
        "units and worst unit, and how late the signal is in the mean, by the delay that fits best. An observer made to agree with a recording that trails "
        "trails as well."
    )
    deployed = where(observers, metrics["study"].get("deployed"))
    return [Table(["observer", *("mean", "worst", "lag (ms)") * len(places)], body, caption, groups, folded=True, emphasised=deployed)]


def _true_cells(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    errors, lags = ([r[f"true_{what}"] for r in rows] for what in ("error_percent", "lag_s"))
    if not rows or None in errors:
        return ["–" if not rows else "diverged", "–", "–"]
    lag = None if None in lags else 1e3 * sum(lags) / len(lags)
    return [number(sum(errors) / len(errors)), number(max(errors)), number(lag)]


def _cells(table: ErrorTable, channel: str, cell: ErrorCell | None, with_interval: bool) -> list[Cell | str]:
    if cell is None:
        return ["–"] * 4
    if cell.mean is None:
        return [number(cell.nominal), Cell("diverged", note=f"{cell.diverged} units"), "–", "–"]
    values = {what: getattr(cell, what) for what in ("nominal", "mean", "worst")}
    notes = {"mean": f"{number(cell.interval[0], 2)}–{number(cell.interval[1], 2)}"} if cell.interval and with_interval else {}
    cells = [Cell(number(v), strong=v is not None and v == table.best(channel, w), note=notes.get(w, "")) for w, v in values.items()]
    return [*cells, number(cell.rms)]
