"""The verdict on a run: READY, CHECK or NOT READY with its reasons, three numbers, and what voids the certificate.

The head of the report and the lines behind ``kros run`` both come from here.
"""

from collections.abc import Iterator, Sequence
from enum import Enum
from math import inf
from operator import itemgetter

import numpy as np

from ..core import TINY, ByName, frozen, grouped
from ..data import some
from ..design.task import split_name
from .facts import ErrorCell, Facts
from .names import condition_label, in_condition, joined, label_of, number, observer_label, words

Checks = Iterator[tuple[str, str, str]]  # what is wrong, what to do, and the section with the details


@frozen
class Thresholds:
    """From where on a difference is a reason to check."""

    better: float = 0.05  # share by which mean errors of another observer are smaller
    improved: float = 0.01  # share by which a correction must reduce the error of the model alone
    large: float = 0.1  # mean error of a hidden channel, share of its largest value
    several: float = 3.0  # error of a unit in a hidden channel over the median of the others; of good ones up to 2.9
    compared: int = 5  # units, from which on their errors are compared: the median bears two that are unlike the others
    noise: float = 0.5  # share of estimation noise in the largest difference between units


THRESHOLDS = Thresholds()


class Status(Enum):
    """Whether an observer can be deployed."""

    READY = "READY"
    CHECK = "CHECK"
    NOT_READY = "NOT READY"


@frozen
class Reason:
    """Why a run is not READY, what to do about it, and the section of the report with the details."""

    status: Status
    text: str
    action: str
    section: str


@frozen
class Number:
    """A number that stands alone, with its unit of measure, what it is, and what puts it into proportion."""

    value: str
    unit: str
    label: str
    notes: Sequence[str] = ()


@frozen
class Verdict:
    """The head of the report."""

    status: Status
    sentence: str
    reasons: Sequence[Reason]
    numbers: Sequence[Number]
    certified: Sequence[str]
    void: Sequence[str]


def judge(facts: Facts) -> Verdict:
    """Return the verdict on a run."""
    reasons = [Reason(Status.NOT_READY, *stop) for stop in _stopping(facts)]
    for checks in (_of_recordings, _of_units, _of_errors, _of_certificates):
        reasons += [Reason(Status.CHECK, *check) for check in checks(facts)]
    status = reasons[0].status if reasons else Status.READY
    certified = certificates(facts)
    void = voids(facts) if certified else []
    return Verdict(status, _sentence(facts, status, reasons), reasons, _numbers(facts), certified, void)


def _sentence(facts: Facts, status: Status, reasons: Sequence[Reason]) -> str:
    """Return the verdict in one sentence."""
    if status is Status.NOT_READY:
        return reasons[0].text
    task = f"estimates {channels(facts.hidden)}" + (f" from {channels(facts.measured)}" if facts.measured else "")
    if status is Status.READY:
        return f"“{facts.label}” can be deployed on units like the {facts.study['units']} recorded ones: it {task}."
    return f"“{facts.label}” {task}. Check {len(reasons)} point{'s' * (len(reasons) > 1)} before it is used."


def channels(names: Sequence[str]) -> str:
    """Return channels for a sentence."""
    return joined(list(map(words, names)))


def _numbers(facts: Facts) -> list[Number]:
    """Return the errors of the hidden channels, and how many units are flagged."""
    numbers = []
    for channel in facts.hidden:
        cell, known = facts.cells[channel], facts.cells[channel].means
        if cell.mean is not None:
            notes = [f"RMS {facts.quantity(channel, known['rms'])}"] if known.get("rms") else []
            if growth := facts.entry.get("left_out_to_training", {}).get(channel):
                notes.append(f"in training {growth:.2f} times as large on units left out")
            unit = max(cell.errors, key=cell.errors.__getitem__)
            notes.append(f"worst unit {unit}: {number(cell.worst)} %")
            worst, mean = _worst(facts, channel)
            if worst != facts.table.condition:
                size = "diverged" if mean == inf else f"{number(mean)} %"
                notes.append(f"{condition_label(worst) or worst}: {size}")
            if error := known.get("true_error_percent"):
                lag_s = known.get("true_lag_s", 0.0)
                lag = f", {number(abs(1e3 * lag_s), 2)} ms {'late' if lag_s > 0 else 'early'}" if lag_s else ""
                notes.append(f"against the true signal: {number(error)} %{lag}")
            label = f"error of {words(channel)}{facts.home}"
            numbers.append(Number(number(cell.mean), "% of the largest value", label, notes))
    if rows := facts.get("outliers"):
        flagged, open_ = sorted({r["unit"] for r in rows if r["outlier"]}), undecided(rows)
        notes = [some(flagged) or "none", *([f"UNDECIDED: {len(open_)} of {len(rows)} scores"] if open_ else [])]
        numbers.append(Number(str(len(flagged)), f"of {len({r['unit'] for r in rows})}", "units flagged", notes))
    return numbers


def _worst(facts: Facts, channel: str) -> tuple[str, float]:
    """Return the condition in which the deployed observer's error of a channel is largest, and the error."""
    known = [table for table in facts.tables if facts.deployed in table.cells]
    return max(((t.condition, t.mean(facts.deployed, [channel])) for t in known), key=itemgetter(1))


def _stopping(facts: Facts) -> Checks:
    """Yield what stops, what to do, and where the details are."""
    hidden = facts.hidden
    if not facts.cells:
        yield "The run stopped before an observer was designed and evaluated.", "Run it to its end.", "run"
    elif any(_worst(facts, c)[1] == inf for c in hidden):
        text = f"The estimates of “{facts.label}” diverge on held-out episodes."
        yield text, "Do not use it; look at the models first.", "models"
    elif hidden and not_improved(facts) == hidden:
        text = f"“{facts.label}” is no better than its model without correction."
        yield text, f"Measure a signal that depends more on {channels(hidden)}.", "errors"
    left_out = facts.tables_of(facts.get("left_out").get("rows", ()))
    lost = [c for table in left_out[:1] for c, cell in table.cells.get(facts.deployed, {}).items() if cell.mean is None]
    if set(lost) - set(facts.measured):
        text = "Designed without the unit that it runs on, this kind of observer diverges on some units."
        yield text, "Do not use it on new units.", "left-out"


def _of_recordings(facts: Facts) -> Checks:
    """Yield alerts of the recordings, and a spread that is noise."""
    for alert in facts.study.get("alerts", ()):
        yield f"Recordings: {alert.rstrip('.')}.", "Look at the recordings.", "recordings"
    noise = facts.get("uncertainty").get(facts.model, {}).get("noise_share")
    if noise and noise["at_peak"] >= THRESHOLDS.noise:
        text = f"{100 * noise['at_peak']:.0f} % of the spread at {number(noise['peak_hz'])} Hz is estimation noise, "
        yield f"{text}not variation between units.", "Record longer, or more episodes.", "spread"


def _of_units(facts: Facts) -> Checks:
    """Yield units that are flagged, undecided, have a remark, or several times the error of the others."""
    rows = facts.get("outliers")
    if flagged := [r for r in rows if r["outlier"]]:
        text = f"Flagged as not belonging to the batch: {units_text(flagged)}."
        yield text, "Inspect these units before they are shipped.", "units"
    actions = {
        "not enough data": "Record longer; the table of units says for how long.",
        "cannot tell": "Score against more units in one condition, at least 8, that are more alike.",
    }
    for status, action in actions.items():
        if few := [r for r in rows if r.get("status") == status]:
            which = f"{len(few)} of {len(rows)} outlier scores are not conclusive: {units_text(few)}"
            none = f"No outlier score is conclusive ({len(few)} of {len(rows)})"
            yield f"{none if len(few) == len(rows) else which}.", action, "units"
    if remarks := [f"{r['unit']} ({r['status']})" for r in facts.get("units") if r.get("status", "ok") != "ok"]:
        yield f"Units with a remark: {some(remarks)}.", "Record all units in the same conditions.", "units"
    if unlike := units_of_large_errors(facts):
        text = f"Units with several times the error of the others: {some(unlike)}."
        action = "Inspect these units; leave them out if they are defective, since they make the observer worse."
        yield text, action, "units"


def units_of_large_errors(facts: Facts) -> list[str]:
    """Return units whose error in a hidden channel, relative and absolute, is far above the median of the others."""
    rows = [
        r
        for r in facts.get("evaluation")
        if r["observer"] == facts.deployed
        and r["role"] != "outlier"
        and r["channel"] in facts.hidden
        and r["error_percent"] is not None
    ]
    texts = []
    for (condition, channel), of in grouped(rows, itemgetter("condition", "channel")).items():
        sizes = np.array([(r["error_percent"], r["rms"]) for r in of])
        for k, row in enumerate(of if len(of) >= THRESHOLDS.compared else ()):
            ratio = (sizes[k] / np.maximum(np.median(np.delete(sizes, k, axis=0), axis=0), TINY)).min()
            if ratio >= THRESHOLDS.several:
                place = f"{row['unit']}{in_condition(condition)}"
                error = f"{number(row['error_percent'])} % in {words(channel)}"
                texts.append(f"{place} has {error}, {number(ratio, 2)} times their median")
    return texts


def _of_errors(facts: Facts) -> Checks:
    """Yield better observers, channels without improvement, and bounds that errors exceed."""
    hidden, mean, ratio = facts.hidden, facts.table.mean, 1 - THRESHOLDS.better
    limits = {c: ratio * mean(facts.deployed, [c]) for c in hidden}
    better = {n: [c for c in hidden if mean(n, [c]) < limits[c]] for n in facts.table.cells}
    ranked = sorted(better, key=lambda name: (-len(better[name]), mean(name, better[name])))
    best = [name for c in hidden for name in [n for n in ranked if c in better[n]][:1]]
    for name in dict.fromkeys(best):
        where = "in all hidden channels" if better[name] == hidden else f"of {channels(better[name])}"
        designed = "relift_certified" in facts.observers.get(name, {})
        export = f"`kros export c --observer {name}` exports it."
        action = export if designed else "It is a baseline that is not exported."
        condition = in_condition(facts.table.condition)
        text = f"“{observer_label(name)}” has smaller errors {where}{condition}{_where_lost(facts, name)}."
        yield text, f"Compare both. {action}", "errors"
    same = not_improved(facts)
    if 0 < len(same) < len(hidden):
        text = f"The correction does not improve {channels(same)}: the model alone is as good."
        yield text, "Do not rely on the estimate more than on the model.", "errors"
    if large := {c: e for c in hidden if inf > (e := _worst(facts, c)[1]) > 100 * THRESHOLDS.large}:
        each = joined([f"{words(c)} ({number(e)} % of the largest value)" for c, e in large.items()])
        yield f"The error is large: {each}.", "Measure another signal, or use the estimate for trends alone.", "errors"
    for channel, bound in facts.entry.get("set_bound", {}).items():
        if exceeding := _exceeding(facts, channel, bound):
            text = f"A held-out episode exceeds the largest RMS error expected: {words(channel)} of unit "
            rms, expected = (facts.quantity(channel, v) for v in (facts.cells[channel].worst_rms, bound))
            text += f"{exceeding[0]} has {rms}, expected were {expected}."
            yield text, "Do not rely on this number; record more kinds of episodes.", "certificates"


def _where_lost(facts: Facts, name: str) -> str:
    """Return that an observer errs more than the deployed one where measurements are lost, for a sentence."""
    error, deployed = (facts.observers.get(n, {}).get("loss_error_percent", 0.0) for n in (name, facts.deployed))
    if deployed is None or (error is not None and error <= deployed):
        return ""
    text = "it diverges" if error is None else f"its error is up to {number(error)} % of the largest value"
    return f", but where measurements are lost {text} (the deployed one: {number(deployed)} %)"


def _exceeding(facts: Facts, channel: str, bound: float | None) -> list[str]:
    """Return units whose RMS error on held-out episodes exceeds a bound, the largest first."""
    rms = facts.cells.get(channel, ErrorCell()).rms
    return sorted((u for u in rms if bound is not None and rms[u] > bound), key=rms.__getitem__, reverse=True)


def _of_certificates(facts: Facts) -> Checks:
    """Yield what is not certified or bounded, and folds that failed."""
    if facts.entry.get("relift_certified") is False:
        action = "Test it in parallel before anything depends on it."
        yield "No certificate at run time covers the observer.", action, "certificates"
    if outside := facts.entry.get("set_outside"):
        text = f"Outside the set of recorded signals that the certificate covers: {some(outside)}."
        yield text, "Do not rely on the bounds for these units.", "certificates"
    if facts.observers and all(label_of(name).baseline for name in facts.observers):
        yield "No robust observer could be designed for this population.", "See why.", "certificates"
    for fold, why in facts.get("left_out").get("failed", {}).items():
        text = f"Fold {int(fold) + 1} of the units left out failed: {why}"
        yield text, "Correct it, and run the study again.", "left-out"


def undecided(rows: Sequence[ByName]) -> list[ByName]:
    """Return the outlier scores that decide nothing."""
    return [r for r in rows if r.get("status") in ("not enough data", "cannot tell")]


def units_text(rows: Sequence[ByName]) -> str:
    """Return units with their conditions, for a sentence."""
    units = grouped(rows, itemgetter("unit")).items()
    named = {unit: ", ".join(filter(None, (condition_label(r["condition"]) for r in of))) for unit, of in units}
    return some([f"{unit} ({conditions})" if conditions else unit for unit, conditions in named.items()])


def certificates(facts: Facts) -> list[str]:
    """Return what is certified about the deployed observer."""
    entry, texts = facts.entry, []
    if entry.get("worst_case_h2") is not None:
        norm = number(entry["worst_case_h2"])
        texts.append(f"For the set of linear plants: the H2 norm of the error is at most {norm}.")
    bounds = {c: b for c, b in entry.get("set_bound", {}).items() if b is not None and entry.get("set_certified")}
    hidden = [c for c in bounds if c not in facts.measured] or list(bounds)
    if hidden:
        exceeded = {c: some(_exceeding(facts, c, bounds[c])) for c in hidden}
        notes = {c: f" (exceeded by unit {units})" for c, units in exceeded.items() if units}
        parts = [f"{facts.quantity(c, bounds[c])} in {words(c)}{notes.get(c, '')}" for c in hidden]
        bank = split_name(facts.deployed)[1] == "estimator"
        source = "Measured on units left out of its regression" if bank else "For recorded signals"
        which = "each" if len(hidden) > 1 else "it"
        share = f"; about one new unit in {facts.study['units'] + 1} exceeds {which}" if bank else ""
        texts.append(f"{source}: the RMS error is at most {joined(parts)}{share}.")
    if entry.get("relift_certified"):
        gain = number(entry.get("relift_gain"))
        texts.append(f"At run time: the gain from the model's one-step residual to the error is at most {gain}.")
    return texts


def voids(facts: Facts) -> list[str]:
    """Return when the certificates of the deployed observer do not hold, the most frequent mistake first."""
    texts = [
        "A controller uses the estimate, on which recordings did not depend: kros loop gives the margin of the loop."
    ]
    if facts.entry.get("set_certified") or facts.entry.get("worst_case_h2") is not None:
        texts += [
            "The motion differs from the recorded one, or leaves the range of training.",
            "The unit is worn, badly assembled, or of another batch.",
        ]
    rate = 1 / facts.study["sample_period_s"]
    return [*texts, f"The rate is not {rate:g} Hz, or the sensor, the delay or the loss of samples is not as declared."]


def not_improved(facts: Facts) -> list[str]:
    """Return the hidden channels in which the deployed observer is no better than its model without correction."""
    other, ratio, mean = f"{facts.model}/open_loop", 1 - THRESHOLDS.improved, facts.table.mean
    if other not in facts.table.cells:
        return []
    return [c for c in facts.hidden if not mean(facts.deployed, [c]) < ratio * mean(other, [c])]
