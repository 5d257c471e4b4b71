"""The first paragraph: what was recorded, which observer is deployed, how well it works, which units are flagged; numbers from the metrics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..data.population import DEFAULT_CONDITION
from .caveats import conditions_apart, confounded_text
from .disturbances import needed_sensor
from .error_tables import ErrorTable, home_table, left_out_tables
from .names import (
    BASELINES,
    channel_units,
    condition_label,
    form_label,
    joined,
    minus,
    number,
    observer_label,
    split_observer,
)
from .trust import trust_of

Metrics = Mapping[str, Any]


def verdict(metrics: Metrics, measured: tuple[str, ...] = ()) -> list[str]:
    """Return the sentences of the verdict from ``metrics.json``, any part of which may be absent; errors of `measured` channels are left to the table."""
    return [
        *_recorded(metrics),
        *_deployed(metrics, measured),
        *needed_sensor(metrics, measured),
        *_left_out(metrics, measured),
        *_next_unit(metrics),
        *_covered(metrics),
        *_certificate(metrics),
    ]


def _recorded(metrics: Metrics) -> list[str]:
    study = metrics["study"]
    conditions = " and ".join(condition_label(c) for c in study["conditions"] if c != DEFAULT_CONDITION)
    units = f"{study['units']} unit" + ("s" if study["units"] != 1 else "")
    batch = "" if conditions_apart(metrics) else " of one batch"
    return [f"{units}{batch} were recorded" + (f" ({conditions})." if conditions else "."), *confounded_text(metrics)]


def _deployed(metrics: Metrics, measured: tuple[str, ...]) -> list[str]:
    name = metrics["study"].get("deployed")
    if name is None:
        return ["The run stopped before an observer was made."]
    sentences = [f"The deployed observer is “{observer_label(name)}”."]
    table = home_table(metrics)
    if table is None:
        return [*sentences, "It has not been evaluated."]
    hidden = table.hidden(measured, name)
    source = f"From {' and '.join(measured)} alone it" if measured else "It"
    known = [c for c in hidden if table.cells[name][c].mean is not None]
    if not known:
        return [*sentences, "Its estimates diverge on held-out episodes: do not use it."]
    units = channel_units(metrics)
    parts = [_channel(table, name, c, units.get(c, "")) for c in known]
    shown = ", as the declared sensor shows them," if metrics["study"].get("sensor") else ""
    sentences.append(
        f"{source} estimates {joined(parts)} on held-out episodes{shown} of units that are not the nominal one, in the mean."
    )
    return [*sentences, *_open_loop(table, name, known), *_rivals(table, name, known)]


def _left_out(metrics: Metrics, measured: tuple[str, ...]) -> list[str]:
    """What the same method does on units that took no part."""
    name, rows = metrics["study"].get("deployed"), metrics.get("left_out", {}).get("rows", [])
    tables = left_out_tables(rows, metrics["study"]["identify_on"])
    if not tables or name not in tables[0].cells:
        return []
    cells = {c: cell for c, cell in tables[0].cells[name].items() if c not in measured}
    if any(cell.mean is None for cell in cells.values()):
        return [
            "Designed without the unit it runs on, the same kind of observer diverges on some units: do not use it on new ones."
        ]
    parts = [
        f"{c.replace('_', ' ')} to {number(v.mean)} % ({number(v.worst)} % on the worst unit, {v.worst_unit})"
        for c, v in cells.items()
    ]
    if not parts:
        return []
    text = f"Designed without the unit it runs on, the same kind of observer estimates {joined(parts)}, in the mean (empirical)."
    return [text, *_rivals(tables[0], name, list(cells))]


def _next_unit(metrics: Metrics) -> list[str]:
    """What units that took part in nothing say about the next one."""
    found = metrics.get("next_unit")
    if not found:
        return []
    if found["bounds"] is None:
        return [f"Nothing is known with confidence about the next unit: {found['reason']}."]
    parts = [
        f"{c.replace('_', ' ')} to {number(b['error_percent'])} %"
        for c, b in found["bounds"].items()
        if b["error_percent"] is not None
    ]
    home = "" if found["condition"] == DEFAULT_CONDITION else f" ({condition_label(found['condition'])})"
    level, n = f"{100 * found['confidence']:g}", found["reserve"]
    return [
        f"With {level} % confidence it estimates {joined(parts)} or better on the next unit of the batch{home}: {n} units took part in nothing."
    ]


def _channel(table: ErrorTable, name: str, channel: str, unit: str) -> str:
    cell = table.cells[name][channel]
    more = [f"RMS {number(cell.rms)}{' ' + unit if unit not in ('', '1') else ''}"] if cell.rms is not None else []
    more += [f"{number(cell.worst)} % on the worst unit, {cell.worst_unit}"] if cell.worst is not None else []
    return f"{channel.replace('_', ' ')} to {number(cell.mean)} % of the largest value" + (
        f" ({'; '.join(more)})" if more else ""
    )


def _open_loop(table: ErrorTable, name: str, channels: list[str]) -> list[str]:
    same = f"{split_observer(name)[0]}/open_loop"
    other = same if same in table.cells else next((o for o in table.cells if split_observer(o)[1] == "open_loop"), None)
    if other is None or other == name:
        return []
    theirs = {c: table.cells[other][c].mean for c in channels if c in table.cells[other]}
    if any(value is None for value in theirs.values()):
        return ["Open loop, the nominal model alone, diverges on some units."]
    parts = [
        f"{c.replace('_', ' ')} {number(v)} %{_ratio(table.cells[name][c].mean, v)}"
        for c, v in theirs.items()
        if v is not None
    ]
    return [f"Open loop, the nominal model alone, gives {joined(parts)}."]


def _rivals(table: ErrorTable, name: str, channels: list[str]) -> list[str]:
    """The best of all baselines in every channel, whichever it is, with its name."""
    parts = []
    for channel in channels:
        means = {
            o: cells[channel].mean
            for o, cells in table.cells.items()
            if channel in cells and split_observer(o)[1] in BASELINES
        }
        theirs = {o: mean for o, mean in means.items() if mean is not None and o != name}
        if theirs and channel in table.ranked:
            best = min(theirs, key=lambda o: theirs[o])
            ratio = _ratio(table.cells[name][channel].mean, theirs[best])
            parts.append(f"{channel.replace('_', ' ')} “{observer_label(best)}”, {number(theirs[best])} %{ratio}")
    return [f"The best baseline is for {joined(parts)}."] if parts else []


def _ratio(own: float | None, theirs: float) -> str:
    if not own:
        return ""
    ratio = theirs / own
    if 0.99 < ratio < 1.01:
        return " (the same)"
    if ratio > 1.95:
        return f" ({number(ratio, 2)} times as much)"
    return f" ({100 * (ratio - 1):.0f} % more)" if ratio > 1 else f" ({100 * (1 - ratio):.0f} % less)"


def _covered(metrics: Metrics) -> list[str]:
    """The uncertain set of the deployed observer."""
    name = metrics["study"].get("deployed") or ""
    entry = metrics.get("uncertainty", {}).get(split_observer(name)[0])
    if split_observer(name)[1] == "memory":
        return ["It was identified from the recordings of these units, not designed for a set of machines."]
    if entry is None or entry["peak_db"].get(entry["form"]) is None:
        return []
    peak, cover = minus(f"{entry['peak_db'][entry['form']]:.1f}"), entry["weight"]["cover_max"]
    covers = "cover the" if cover is not None and cover <= 1 else "do not cover all"
    return [
        f"The set of machines it is designed for ({form_label(entry['form'])}) has residuals of at most {peak} dB around unit {entry['nominal']}; "
        f"its weights {covers} units that it was made from."
    ]


def _certificate(metrics: Metrics) -> list[str]:
    name = metrics["study"].get("deployed") or ""
    entry, sentences = metrics.get("observers", {}).get(name, {}), []
    if entry.get("worst_case_h2") is not None:
        gap = entry.get("gap_percent")
        near = f", at most {number(gap)} % above what any correction of this kind can reach" if gap is not None else ""
        sentences.append(f"Its error is certified for all plants inside the uncertain set{near}.")
    trust = trust_of(entry)
    if trust.signals:
        bounds = joined([f"{number(value)} % in {state.replace('_', ' ')}" for state, value in trust.signals.items()])
        sentences.append(
            f"For all signals with the power that was recorded its RMS errors are at most {bounds} (of the largest value)."
        )
    if entry.get("relift_certified") is not None:
        which = "Another certificate" if sentences else "A certificate"
        sentences.append(
            f"{which} covers it as it runs, re-lifted at every step, on any machine."
            if entry["relift_certified"]
            else "No certificate could be found for it as it runs, re-lifted at every step."
        )
    return sentences
