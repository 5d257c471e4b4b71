"""What to do next, from the metrics: a few sentences, each with its reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from .error_tables import ErrorTable, home_table
from .names import condition_label, model_label, number, observer_label, split_observer
from .sections.uncertainty import MANY


def advice(metrics: Mapping[str, Any], measured: tuple[str, ...] = ()) -> list[str]:
    """Return what ``metrics.json`` asks for, given the channels that are measured at run time; nothing for a run that stopped before an observer was made."""
    if metrics["study"].get("deployed") is None:
        return []
    return [*_outliers(metrics), *_observer(metrics, measured), *_recordings(metrics)]


def _outliers(metrics: Mapping[str, Any]) -> list[str]:
    """Name flagged units, the highest score first, and those about which the scores say nothing."""
    flagged = sorted((r for r in metrics.get("outliers", []) if r["outlier"]), key=lambda r: -float(r["score"]))
    first: dict[str, Mapping[str, Any]] = {}
    for row in flagged:
        first.setdefault(row["unit"], row)
    units = [f"{u} ({_where(r)})" for u, r in first.items()]
    if not units:
        return _undecided(metrics)
    filed = {row["unit"] for row in metrics.get("units", []) if row["group"] == "outliers"}
    text = f"Inspect {', '.join(units[:5])}{' and others' if len(units) > 5 else ''} before shipping."
    if any(u not in filed for u in first):
        text += " Flagged units still count in the design; set uncertainty.drop_outliers = true to leave them out."
    return [text, *_undecided(metrics)]


def _undecided(metrics: Mapping[str, Any]) -> list[str]:
    """Say what it would take for a score to mean something."""
    rows = metrics.get("outliers", [])
    short = [r for r in rows if r.get("status") == "not enough data"]
    texts = []
    if short:
        most = max(short, key=lambda r: float(r["needed_s"]))
        units = list(dict.fromkeys(r["unit"] for r in short))
        texts.append(
            f"Record {', '.join(units[:5])}{' and others' if len(units) > 5 else ''} for longer before trusting their scores: {most['unit']} "
            f"({condition_label(most['condition'])}) needs about {number(most['needed_s'])} s and has {number(most['recorded_s'])} s."
        )
    if any(r.get("status") == "cannot tell" for r in rows):
        texts.append(
            "Score against more units: with these, only defects far beyond their differences would have been flagged."
        )
    return texts


def _where(row: Mapping[str, Any]) -> str:
    at = f", differs most at {number(row['freq_hz'])} Hz" if row.get("freq_hz") is not None else ""
    return f"{condition_label(row['condition'])}{at}"


def _observer(metrics: Mapping[str, Any], measured: tuple[str, ...]) -> list[str]:
    """Say whether the deployed observer should be used."""
    name = metrics["study"]["deployed"]
    table = home_table(metrics)
    if table is None:
        return []
    hidden = table.hidden(measured, name)
    if any(table.cells[name][c].mean is None for c in hidden):
        return [
            f"Do not use “{observer_label(name)}”: its estimates diverge. Look at Models first: free runs there should not diverge either."
        ]
    if (better := better_observer(table, name, hidden)) is not None:
        return [
            f"Look at “{observer_label(better)}” before deploying anything: it is better in all that is not measured. Compare under Trust; "
            "observer.deployed names the one that is deployed."
        ]
    if hidden and not_improved(table, name, hidden) == hidden:
        return [
            "The observer is no better than its model alone: measure something that tells more of what is hidden, or look at Models."
        ]
    entry = metrics.get("observers", {}).get(name, {})
    text = "Try it on recordings with “kros estimate”, then hand observers/deployed.json over: “kros export” writes C99 or an FMU."
    if entry.get("relift_certified") is False:
        text += " No certificate covers it as it runs, so let it run beside the machine before anything depends on it."
    return [text]


def better_observer(table: ErrorTable, name: str, channels: Sequence[str]) -> str | None:
    """Return the most accurate of the observers that are better in every channel by 5 % at least; None where there is none."""
    better = [o for o in table.cells if o != name and _smaller(table, o, name, channels, 0.95)]
    return min(better, key=lambda o: sum(table.cells[o][c].mean or 0.0 for c in channels), default=None)


def not_improved(table: ErrorTable, name: str, channels: Sequence[str]) -> list[str]:
    """Return the channels in which an observer is no better than its model without correction."""
    other = f"{split_observer(name)[0]}/open_loop"
    return (
        [c for c in channels if not _smaller(table, name, other, [c], 0.99)]
        if name != other and other in table.cells
        else []
    )


def _smaller(table: ErrorTable, one: str, other: str, channels: Sequence[str], ratio: float) -> bool:
    """Whether the mean errors of one observer are below a ratio of another's, in all channels."""
    known = [c for c in channels if c in table.cells[one] and c in table.cells[other]]
    pairs = [(table.cells[one][c].mean, table.cells[other][c].mean) for c in known]
    return len(pairs) == len(channels) and all(a is not None and (b is None or a < ratio * b) for a, b in pairs)


def _recordings(metrics: Mapping[str, Any]) -> list[str]:
    """Say whether more recordings or fewer unlike units would bring the uncertainty of the model in use down."""
    model = split_observer(metrics["study"]["deployed"])[0]
    entry = metrics.get("uncertainty", {}).get(model, {})
    if "noise_share" not in entry:
        return []
    share, where = entry["noise_share"]["at_peak"], number(entry["noise_share"]["peak_hz"])
    differ = f"of how much {model_label(model)} models differ, where they do most ({where} Hz),"
    if share >= MANY:
        return [f"Record longer or more episodes: {100 * share:.0f} % {differ} comes from the recordings' length."]
    return [
        f"Longer recordings of these units would change little: {100 * (1 - share):.0f} % {differ} remains when episodes are resampled."
    ]
