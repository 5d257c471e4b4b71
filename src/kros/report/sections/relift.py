"""What is certified about the observers as they run, and how close their errors come to it."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from ...core.artifacts import load_artifact
from ..content import Cell, Section, Table, where
from ..names import number, observer_label
from ..run_folder import RunFolder

Rows = Sequence[Mapping[str, Any]]
_TEXT = (
    "An observer that cuts its estimate back to the original states and re-lifts it at every step is not linear, and no linear certificate covers it. Its "
    "error is driven by the one-step residual alone: what the nominal model misses from one sample to the next, whatever the reason. For every unit, known or "
    "not, the error's RMS is at most the gain times the residual's, plus what the first error costs. The residual is divided by its size in this population "
    "and errors by the ranges: on a unit with the typical residual the gain itself bounds the error."
)
_BOUND = (
    "The gain holds for the worst course of the residual. From the residual as it was, two things follow: the response of the observer with the lifted "
    "functions' slopes in the middle of their interval, and, times the mismatch gain, what their movement can add. The bounds below take the smaller of both, "
    "on the first five seconds of a training episode of every unit."
)
_SIGNALS = (
    "Of the recorded signals more is known than their size: how much power they have in every band of frequency. Whatever course signals of these powers take, "
    "the error of a state stays below the bound of the second table, start included. The first columns are for all signals inside a cover of all units; the "
    "last two are the bounds for single units, from their own powers, over the errors of the states that are not measured."
)


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the certificates of the observers as they run; None where there are none."""
    observers = {
        name: entry for name, entry in metrics.get("observers", {}).items() if entry.get("relift_certified") is not None
    }
    if not observers or not run.has("observers/relift.json"):
        return None
    record = load_artifact(run.folder / "observers", "relift")[0]
    deployed = metrics["study"].get("deployed")
    failed = [
        f"No certificate was found for “{observer_label(name)}” as it runs: {entry['relift_reason']}"
        for name, entry in observers.items()
        if not entry["relift_certified"]
    ]
    rows = [_row(name, entry, record["rows"].get(name, [])) for name, entry in observers.items()]
    head = ["observer", "gain", "mismatch gain", "bound", "error", "bound", "error"]
    caption = "Errors in percent of the largest value, RMS over time, the states' squares added."
    groups = [("", 3), ("median unit", 2), ("worst unit", 2)]
    table = Table(head, rows, caption, groups, emphasised=where(observers, deployed))
    assumptions = record["certificates"].get(deployed, {}).get("assumptions", [])
    conditions = (
        [f"Assumed for “{observer_label(deployed)}”: {'; '.join(assumptions)}."] if deployed and assumptions else []
    )
    signals = _signals(observers, deployed)
    return Section(
        "relift",
        "Certified as it runs",
        [_TEXT, _BOUND, *([_SIGNALS] if signals else []), *conditions, *failed],
        [table, *signals],
    )


def _row(name: str, entry: Mapping[str, Any], rows: Rows) -> list[Cell | str]:
    if not rows:
        return [observer_label(name), Cell("none", strong=True), *(["–"] * 5)]
    values = [statistics.median(row[key] for row in rows) for key in ("bound", "error")]
    values += [max(row[key] for row in rows) for key in ("bound", "error")]
    gains = number(entry["relift_gain"]), number(entry.get("relift_mismatch_gain"))
    return [observer_label(name), *gains, *(number(100 * v) for v in values)]


def _signals(observers: Mapping[str, Mapping[str, Any]], deployed: str | None) -> list[Table]:
    """Return bounds for recorded signals, and gains with losses where a rate is declared."""
    states = next((list(e["set_bound_percent"]) for e in observers.values() if "set_bound_percent" in e), None)
    if states is None:
        return []
    lossy = any("dropout_rate" in entry for entry in observers.values())
    head, rows = ["observer", *states, "least", "most", *(["gain, losses at random"] if lossy else [])], []
    for name, entry in observers.items():
        bounds = entry.get("set_bound_percent", {})
        over = [number(entry.get(f"set_bound_to_error_{which}")) for which in ("min", "max")]
        lost = number(entry.get("dropout_mean_square_gain")) if entry.get("dropout_certified") else "none"
        rows.append(
            [observer_label(name), *(number(bounds.get(state)) for state in states), *over, *([lost] if lossy else [])]
        )
    groups = [
        ("", 1),
        ("bound for any unit, % of the largest value", len(states)),
        ("bound over error, units", 2),
        *([("", 1)] if lossy else []),
    ]
    return [
        Table(
            head,
            rows,
            "Bounds on RMS errors for signals like those recorded",
            groups,
            emphasised=where(observers, deployed),
        )
    ]
