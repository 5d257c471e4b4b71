"""The verdict on a run: READY, CHECK or NOT READY with its reasons, three numbers, and what voids the certificate.

The head of the report and the lines behind ``kros run`` are both made here, from ``metrics.json`` alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from .error_tables import ErrorTable, home_table, left_out_tables
from .names import (
    BASELINES,
    channel_text,
    condition_label,
    joined,
    minus,
    model_label,
    number,
    observer_label,
    readable_unit,
    some_of,
    split_observer,
    words,
)

Metrics = Mapping[str, Any]
BETTER = 0.05  # share by which all mean errors of an observer lie below another's where it is called more accurate
NO_GAIN = 0.01  # share below which a correction is said to bring nothing
SMALL_SET = 5.0  # ratio of a model's error to the size of its uncertain set from which on the set is called small


class Status(Enum):
    """Whether an observer can be deployed."""

    READY = "READY"
    CHECK = "CHECK"
    NOT_READY = "NOT READY"


@dataclass(frozen=True)
class Reason:
    """Why a run is not READY, what to do about it, and the section of the report with the details."""

    status: Status
    text: str
    action: str
    section: str


@dataclass(frozen=True)
class Number:
    """A number that stands alone, with its unit of measure, what it is, and what puts it into proportion."""

    value: str
    unit: str
    label: str
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Verdict:
    """What stands at the head of the report."""

    status: Status
    sentence: str
    reasons: Sequence[Reason]
    numbers: Sequence[Number]
    certified: Sequence[str]
    void: Sequence[str]


def judge(metrics: Metrics) -> Verdict:
    """Return the verdict from ``metrics.json``, any part of which but ``study`` may be absent."""
    reasons = [*_stops(metrics), *_checks(metrics)]
    known = [reason.status for reason in reasons]
    status = next((s for s in (Status.NOT_READY, Status.CHECK) if s in known), Status.READY)
    certified = certificates(metrics)
    void = voids(metrics) if certified else []
    return Verdict(status, _sentence(metrics, status, reasons), reasons, _numbers(metrics), certified, void)


def measured_of(metrics: Metrics) -> tuple[str, ...]:
    """Return the channels that are measured at run time."""
    return tuple(metrics["study"].get("measured", ()))


def _sentence(metrics: Metrics, status: Status, reasons: Sequence[Reason]) -> str:
    """Return the verdict in one sentence."""
    study, table, measured = metrics["study"], home_table(metrics), measured_of(metrics)
    if status is Status.NOT_READY:
        return next(reason.text for reason in reasons if reason.status is Status.NOT_READY)
    if table is None:
        return "No observer has been evaluated yet."
    name = observer_label(study["deployed"])
    hidden = joined([words(c) for c in table.hidden(measured, study["deployed"])])
    source = f" from {joined([words(c) for c in measured])}" if measured else ""
    if status is Status.READY:
        return f"“{name}” can be deployed on machines like the {study['units']} recorded ones: it estimates {hidden}{source}."
    count = f"{len(reasons)} point{'s' if len(reasons) > 1 else ''}"
    return f"“{name}” estimates {hidden}{source}. Check {count} before it is used."


def _numbers(metrics: Metrics) -> list[Number]:
    """Return the errors of at most two hidden channels, and how many units are flagged."""
    name, table = metrics["study"].get("deployed"), home_table(metrics)
    units = metrics["study"].get("channels", {})
    numbers = []
    for channel in table.hidden(measured_of(metrics), name)[:2] if table is not None else []:
        cell = table.cells[name][channel] if table is not None else None
        if cell is None or cell.mean is None:
            continue
        notes = [f"RMS {number(cell.rms)} {readable_unit(units.get(channel, ''))}".strip()] if cell.rms else []
        notes += [f"worst unit {cell.worst_unit}: {number(cell.worst)} %"]
        notes += [f"against the true signal: {number(cell.true_mean)} %{_lag(cell.lag_s)}"] if cell.true_mean else []
        numbers.append(Number(number(cell.mean), "% of the largest value", f"error of {words(channel)}", notes))
    rows = metrics.get("outliers", [])
    if rows:
        flagged, every = ({r["unit"] for r in rows if r["outlier"] or keep} for keep in (False, True))
        open_ = undecided(rows)
        note = some_of(sorted(flagged)) if flagged else "none"
        notes = [note, *([f"UNDECIDED: {len(open_)} of {len(rows)} scores"] if open_ else [])]
        numbers.append(Number(str(len(flagged)), f"of {len(every)}", "units flagged", notes))
    return numbers


def _lag(lag_s: float | None) -> str:
    """Return how late a signal is, for a sentence."""
    return "" if lag_s is None else f", {number(abs(1e3 * lag_s), 2)} ms {'late' if lag_s > 0 else 'early'}"


def _stops(metrics: Metrics) -> Iterator[Reason]:
    """Yield why the observer must not be used."""
    study, table, measured = metrics["study"], home_table(metrics), measured_of(metrics)
    name = study.get("deployed")
    if name is None:
        yield Reason(Status.NOT_READY, "The run stopped before an observer was designed.", "Run it to its end.", "run")
        return
    if table is not None:
        hidden = table.hidden(measured, name)
        if any(table.cells[name][c].mean is None for c in hidden):
            text = f"The estimates of “{observer_label(name)}” diverge on held-out episodes."
            yield Reason(Status.NOT_READY, text, "Do not use it; look at the models first.", "models")
        elif hidden and not_improved(table, name, hidden) == hidden:
            text = f"“{observer_label(name)}” is no better than its model without correction."
            action = f"Measure a signal that depends more on {joined([words(c) for c in hidden])}."
            yield Reason(Status.NOT_READY, text, action, "errors")
    left = left_out_tables(metrics.get("left_out", {}).get("rows", []), study["identify_on"])
    if left and any(cell.mean is None for c, cell in left[0].cells.get(name, {}).items() if c not in measured):
        text = "Designed without the unit that it runs on, this kind of observer diverges on some units."
        yield Reason(Status.NOT_READY, text, "Do not use it on new machines.", "left-out")


def _checks(metrics: Metrics) -> Iterator[Reason]:
    """Yield what has to be checked before the observer is used."""
    for text, action, section in [*_of_recordings(metrics), *_of_units(metrics), *_of_observer(metrics)]:
        yield Reason(Status.CHECK, text, action, section)


def _of_recordings(metrics: Metrics) -> Iterator[tuple[str, str, str]]:
    study = metrics["study"]
    for alert in study.get("alerts", ()):
        yield f"Recordings: {alert}{'' if alert.endswith('.') else '.'}", "Look at the recordings.", "recordings"
    for text in confounded(metrics):
        yield text, "Record all units in the same conditions.", "recordings"
    noise = metrics.get("uncertainty", {}).get(split_observer(study.get("deployed") or "")[0], {}).get("noise_share")
    if noise and noise["at_peak"] >= 0.5:
        where = f"{100 * noise['at_peak']:.0f} % of the spread at {number(noise['peak_hz'])} Hz is estimation noise"
        yield f"{where}, not variation between units.", "Record longer, or more episodes.", "spread"


def _of_units(metrics: Metrics) -> Iterator[tuple[str, str, str]]:
    rows = metrics.get("outliers", [])
    flagged = [r for r in rows if r["outlier"]]
    if flagged:
        text = f"Flagged as not belonging to the batch: {units_text(flagged)}."
        yield text, "Inspect these units before they are shipped.", "units"
    open_ = undecided(rows)
    short = [r for r in open_ if r["status"] == "not enough data"]
    if short:
        most = max(short, key=lambda r: float(r["needed_s"]))
        action = (
            f"Record longer: {most['unit']} needs {number(most['needed_s'])} s, has {number(most['recorded_s'])} s."
        )
        yield _inconclusive(short, rows), action, "units"
    other = [r for r in open_ if r not in short]
    if other:
        action = "Score against at least 8 units in one condition."
        yield _inconclusive(other, rows), action, "units"
    remarks = [f"{r['unit']} ({r['status']})" for r in metrics.get("units", []) if r.get("status", "ok") != "ok"]
    if remarks:
        yield f"Units with a remark: {some_of(remarks)}.", "See their rows.", "units"


def _inconclusive(rows: Sequence[Metrics], every: Sequence[Metrics]) -> str:
    """Say how many scores decide nothing."""
    if len(rows) == len(every):
        return f"No outlier score is conclusive ({len(rows)} of {len(every)})."
    return f"{len(rows)} of {len(every)} outlier scores are not conclusive: {units_text(rows)}."


def _of_observer(metrics: Metrics) -> Iterator[tuple[str, str, str]]:
    study, table, measured = metrics["study"], home_table(metrics), measured_of(metrics)
    name = study.get("deployed")
    if name is None:
        return
    entries, model = metrics.get("observers", {}), split_observer(name)[0]
    if table is not None:
        yield from _of_errors(table, name, table.hidden(measured, name), metrics)
    entry = entries.get(name, {})
    if entry.get("relift_certified") is False:
        action = "Run it beside the machine before anything depends on it."
        yield "No certificate at run time covers the observer.", action, "certificates"
    if outside := entry.get("set_outside"):
        text = f"Outside the set of recorded signals that the certificate covers: {some_of(outside)}."
        yield text, "Do not rely on the bounds for these units.", "certificates"
    if entries and all(split_observer(n)[1] in BASELINES for n in entries):
        yield "No robust observer could be designed for this population.", "See why.", "certificates"
    bound = metrics.get("uncertainty", {}).get(model, {}).get("weight", {}).get("cover_max")
    if bound is not None and bound > 1:
        yield "The weights do not bound all units that they were fitted to.", "Raise their order.", "uncertainty"
    yield from _small_set(metrics, model)
    for fold, why in metrics.get("left_out", {}).get("failed", {}).items():
        yield f"Fold {int(fold) + 1} of the units left out failed: {why}", "See the reason.", "left-out"


def _of_errors(table: ErrorTable, name: str, hidden: list[str], metrics: Metrics) -> Iterator[tuple[str, str, str]]:
    if (better := better_observer(table, name, hidden)) is not None:
        text = f"“{observer_label(better)}” has smaller errors in all hidden channels."
        yield text, f'Compare both; observer.deployed = "{better}" selects it.', "errors"
    same = not_improved(table, name, hidden)
    if 0 < len(same) < len(hidden):
        text = f"The correction does not improve {joined([words(c) for c in same])}: the model alone is as good."
        yield text, "Do not rely on the estimate more than on the model.", "errors"
    for channel, bound in (metrics.get("observers", {}).get(name, {}).get("set_bound") or {}).items():
        worst = table.cells[name].get(channel)
        if worst is not None and worst.worst_rms is not None and bound is not None and worst.worst_rms > bound:
            unit = readable_unit(metrics["study"].get("channels", {}).get(channel, ""))
            text = f"The bound for recorded signals is exceeded on a held-out episode: {words(channel)} of unit "
            text += f"{worst.worst_unit} has {number(worst.worst_rms)} {unit} RMS, the bound is {number(bound)} {unit}."
            yield text, "Do not rely on this bound; record more kinds of episodes.", "certificates"


def _small_set(metrics: Metrics, model: str) -> Iterator[tuple[str, str, str]]:
    """Warn of an uncertain set that is far smaller than the simulation errors of its models."""
    entry = metrics.get("uncertainty", {}).get(model, {})
    peak = entry.get("peak_db", {}).get(entry.get("form"))
    errors = metrics.get("models", {}).get(model, {}).get("freerun_error_percent", {})
    known = {channel: error["median"] for channel, error in errors.items() if error.get("median") is not None}
    if peak is None or not known:
        return
    channel, size = max(known, key=lambda c: known[c]), 100 * 10 ** (peak / 20)
    if known[channel] > SMALL_SET * size:
        yield (
            f"The set of plants is smaller than the errors of its {model_label(model)} models: residuals reach "
            f"{minus(f'{peak:.1f}')} dB ({number(size, 2)} %), the simulation error of {words(channel)} is "
            f"{number(known[channel], 2)} %. The set describes how units differ, not how models differ from machines.",
            "Do not read a bound over the set as a bound on the error.",
            "spread",
        )


def undecided(rows: Sequence[Metrics]) -> list[Metrics]:
    """Return the outlier scores that decide nothing."""
    return [r for r in rows if r.get("status") in ("not enough data", "cannot tell")]


def units_text(rows: Sequence[Metrics]) -> str:
    """Return units with their conditions, for a sentence."""
    units: dict[str, list[str]] = {}
    for row in rows:
        units.setdefault(row["unit"], []).append(condition_label(row["condition"]))
    return some_of([f"{unit} ({', '.join(conditions)})" for unit, conditions in units.items()])


def confounded(metrics: Metrics) -> list[str]:
    """Say where units and conditions are confounded, or where some units took no part in the models."""
    rows = [row for row in metrics.get("units", []) if row.get("conditions") and row.get("group") != "outliers"]
    home = metrics["study"]["identify_on"]
    inside = [row for row in rows if home in row["conditions"]]
    if len(inside) == len(rows):
        return []
    about = (
        f"Models and observers describe {len(inside)} of {len(rows)} units, those recorded in “{condition_label(home)}”"
    )
    if all(len(row["conditions"]) == 1 for row in rows):
        return [f"Units and conditions are confounded: every unit was recorded in one condition only. {about}."]
    return [f"{about}."]


def certificates(metrics: Metrics) -> list[str]:
    """Return what is certified about the deployed observer."""
    entry = metrics.get("observers", {}).get(metrics["study"].get("deployed") or "", {})
    units, texts = metrics["study"].get("channels", {}), []
    if entry.get("worst_case_h2") is not None:
        texts.append(f"For the set of plants: the H2 norm of the error is at most {number(entry['worst_case_h2'])}.")
    if entry.get("set_certified"):
        bounds = {c: b for c, b in (entry.get("set_bound") or {}).items() if b is not None}
        hidden = [c for c in bounds if c not in measured_of(metrics)] or list(bounds)
        parts = [channel_text(c, number(bounds[c]), units.get(c, "")) for c in hidden]
        texts.append(f"For recorded signals: the RMS error is at most {joined(parts)}." if parts else "")
    if entry.get("relift_certified"):
        gain = number(entry.get("relift_gain"))
        texts.append(f"At run time: the gain from the model's one-step residual to the error is at most {gain}.")
    return [text for text in texts if text]


def voids(metrics: Metrics) -> list[str]:
    """Return when the certificates of the deployed observer do not hold, the most frequent mistake first."""
    entry = metrics.get("observers", {}).get(metrics["study"].get("deployed") or "", {})
    texts = ["A controller uses the estimate: the recordings did not depend on it."]
    if entry.get("set_certified") or entry.get("worst_case_h2") is not None:
        texts += ["Signals have more power at some frequency than the recorded ones, or leave the range of training."]
        texts += ["The machine is worn, badly assembled, or of another batch."]
    rate = 1 / metrics["study"]["sample_period_s"]
    return [*texts, f"The rate is not {rate:g} Hz, or the sensor, the delay or the loss of samples is not as declared."]


def better_observer(table: ErrorTable, name: str, channels: Sequence[str]) -> str | None:
    """Return the most accurate of the observers that are better by `BETTER` in every channel; None where none is."""
    better = [o for o in table.cells if o != name and _smaller(table, o, name, channels, 1 - BETTER)]
    return min(better, key=lambda o: table.mean(o, channels), default=None)


def not_improved(table: ErrorTable, name: str, channels: Sequence[str]) -> list[str]:
    """Return the channels in which an observer is no better than its model without correction."""
    other = f"{split_observer(name)[0]}/open_loop"
    if name == other or other not in table.cells:
        return []
    return [c for c in channels if not _smaller(table, name, other, [c], 1 - NO_GAIN)]


def _smaller(table: ErrorTable, one: str, other: str, channels: Sequence[str], ratio: float) -> bool:
    """Tell whether the mean errors of one observer are below a ratio of another's in all channels."""
    known = [c for c in channels if c in table.cells[one] and c in table.cells[other]]
    pairs = [(table.cells[one][c].mean, table.cells[other][c].mean) for c in known]
    return len(pairs) == len(channels) and all(a is not None and (b is None or a < ratio * b) for a, b in pairs)
