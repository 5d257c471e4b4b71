"""The head of the report, for who has half a minute: a traffic light, a sentence, three numbers, what to do; and the list of alerts behind the light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from .advice import better_observer, not_improved
from .caveats import confounded_text, small_set_text
from .content import Alert, Level
from .error_tables import home_table, left_out_tables
from .names import BASELINES, channel_units, joined, number, observer_label, readable_unit, split_observer
from .sections.outliers import flagged_text, undecided_text
from .trust import trust_of

Metrics = Mapping[str, Any]


@dataclass(frozen=True)
class Figure:
    """A number that stands alone, with its unit of measure, what it is, and what puts it into proportion."""

    value: str
    unit: str
    label: str
    note: str = ""


@dataclass(frozen=True)
class Summary:
    """What stands at the head of the page."""

    light: Level
    sentence: str
    figures: Sequence[Figure]
    alerts: Sequence[Alert]


def summary(metrics: Metrics, measured: Sequence[str] = ()) -> Summary:
    """Return the head of the page from ``metrics.json``, any part of which may be absent."""
    alerts = find_alerts(metrics, measured)
    levels = [alert.level for alert in alerts]
    light = next((level for level in (Level.STOP, Level.LOOK) if level in levels), Level.GO)
    return Summary(light, _sentence(metrics, measured, light, alerts), _figures(metrics, measured), alerts)


def _sentence(metrics: Metrics, measured: Sequence[str], light: Level, alerts: Sequence[Alert]) -> str:
    name, table = metrics["study"].get("deployed"), home_table(metrics)
    if light is Level.STOP:
        return next(alert.text for alert in alerts if alert.level is Level.STOP)
    if name is None or table is None:
        return "No observer has been evaluated yet."
    source = f"From {joined(measured)} alone it" if measured else "It"
    hidden = joined([c.replace("_", " ") for c in table.hidden(measured, name)])
    text = f"“{observer_label(name)}” can be deployed. {source} estimates {hidden} on machines like the {metrics['study']['units']} recorded ones."
    return (
        text
        if light is Level.GO
        else f"{text} {len(alerts)} {'point' if len(alerts) == 1 else 'points'} to look at first."
    )


def _figures(metrics: Metrics, measured: Sequence[str]) -> list[Figure]:
    """Errors of at most two hidden channels, then units that are flagged, or how much better than the best baseline."""
    name, table, units = metrics["study"].get("deployed"), home_table(metrics), channel_units(metrics)
    found = []
    if name is not None and table is not None:
        for channel in table.hidden(measured, name)[:2]:
            cell = table.cells[name][channel]
            percent = f"{number(cell.mean)} % of the largest value"
            worst = f"worst unit {cell.worst_unit}: {number(cell.worst)} %"
            title = f"error of {channel.replace('_', ' ')}, RMS"
            if cell.rms is None:
                found.append(Figure(number(cell.mean), "% of the largest value", title, worst))
            else:
                found.append(
                    Figure(number(cell.rms), readable_unit(units.get(channel, "")), title, f"{percent}; {worst}")
                )
    if metrics.get("outliers"):
        flagged = [r for r in metrics["outliers"] if r["outlier"]]
        count = len({r["unit"] for r in flagged})
        every = len({r["unit"] for r in metrics["outliers"]})
        found.append(
            Figure(
                str(count),
                f"of {every} units",
                "flagged as not belonging",
                flagged_text(flagged) if flagged else "none stands out",
            )
        )
    return found


def find_alerts(metrics: Metrics, measured: Sequence[str] = ()) -> list[Alert]:
    """Return all that has to be looked at, the worst first."""
    found = [*_stops(metrics, measured), *_looks(metrics, measured)]
    return [*(a for a in found if a.level is Level.STOP), *(a for a in found if a.level is not Level.STOP)]


def _stops(metrics: Metrics, measured: Sequence[str]) -> list[Alert]:
    study = metrics["study"]
    name, table = study.get("deployed"), home_table(metrics)
    texts = []
    if name is None:
        return [Alert(Level.STOP, "The run stopped before an observer was made.", "making")]
    if table is not None and any(table.cells[name][c].mean is None for c in table.hidden(measured, name)):
        texts.append(
            (
                f"The estimates of “{observer_label(name)}” diverge on held-out episodes: do not use it. See Models first.",
                "models",
            )
        )
    elif table is not None and (hidden := table.hidden(measured, name)) and not_improved(table, name, hidden) == hidden:
        texts.append(
            (
                "The observer is no better than its model alone: correction from these measurements brings nothing here.",
                "observers",
            )
        )
    left = left_out_tables(metrics.get("left_out", {}).get("rows", []), study["identify_on"])
    if left and any(cell.mean is None for c, cell in left[0].cells.get(name, {}).items() if c not in measured):
        texts.append(
            (
                "Designed without the unit it runs on, this kind of observer diverges on some units: do not use it on new ones.",
                "left-out",
            )
        )
    return [Alert(Level.STOP, *text) for text in texts]


def _looks(metrics: Metrics, measured: Sequence[str]) -> list[Alert]:
    study, name = metrics["study"], metrics["study"].get("deployed")
    texts = [(f"Recordings: {alert}", "recordings") for alert in study.get("alerts", ())]
    texts += [(text, "recordings") for text in confounded_text(metrics)]
    flagged = [r for r in metrics.get("outliers", []) if r["outlier"]]
    texts += [(f"Flagged as not belonging to the batch: {flagged_text(flagged)}.", "units")] if flagged else []
    texts += [(text, "units") for text in undecided_text(metrics.get("outliers", []))]
    remarks = [f"{r['unit']} ({r['status']})" for r in metrics.get("units", []) if r.get("status", "ok") != "ok"]
    texts += [(f"Units with a remark: {'; '.join(remarks)}.", "units")] if remarks else []
    if name is None:
        return [Alert(Level.LOOK, *text) for text in texts]
    model, trust, table = (
        split_observer(name)[0],
        trust_of(metrics.get("observers", {}).get(name, {})),
        home_table(metrics),
    )
    if table is not None and (better := better_observer(table, name, table.hidden(measured, name))):
        texts.append((f"“{observer_label(better)}” is more accurate in all that is not measured.", "observers"))
    if table is not None and 0 < len(same := not_improved(table, name, hidden := table.hidden(measured, name))) < len(
        hidden
    ):
        channels = joined([c.replace("_", " ") for c in same])
        texts.append((f"Correction brings nothing for {channels}: the model alone does as well there.", "observers"))
    if trust.running is False:
        texts.append(("No certificate covers the observer as it runs.", "trust"))
    if trust.outside:
        texts.append(
            (
                f"Outside the set of recorded signals that the observer is certified for: {joined(trust.outside)}.",
                "trust",
            )
        )
    if (observers := metrics.get("observers")) and all(split_observer(n)[1] in BASELINES for n in observers):
        texts.append(("No robust observer could be designed for this population; Synthesis says why.", "synthesis"))
    weight = metrics.get("uncertainty", {}).get(model, {}).get("weight", {})
    if weight.get("cover_max") is not None and weight["cover_max"] > 1:
        texts.append(("The weights do not cover all units that they were made from.", "uncertainty"))
    texts += [(text, "uncertainty") for text in small_set_text(metrics, (model,))]
    texts += [
        (f"Fold {int(n) + 1} of the units left out failed: {why}.", "left-out")
        for n, why in metrics.get("left_out", {}).get("failed", {}).items()
    ]
    return [Alert(Level.LOOK, *text) for text in texts]
