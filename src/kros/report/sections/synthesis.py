"""What was designed, and what is certified about it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...core.linalg import radius_text
from ..content import Cell, Cells, Section, Table, where
from ..names import BASELINES, minus, number, observer_label, split_observer
from ..run_folder import RunFolder

_TEXT = (
    "An observer's error is driven by how a unit differs from the nominal model, and by measurement noise. The certified worst case bounds the error's H2 norm "
    "(its RMS for white inputs of unit range) for every member of the uncertain set, recomputed independently of the solver. The lower bound is what no "
    "correction of this kind can beat; the gap is the distance between design and lower bound. The spectral radius is that of the nominal loop and of the "
    "units' own poles; it must be below one, and says nothing about robustness."
)
_HEAD = (
    *("observer", "status", "filter states", "certified worst case", "lower bound", "gap (%)", "spectral radius"),
    *("as it runs", "solved in (s)"),
)


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the certificate table, of columns in which something is known, and what could not be designed or certified."""
    observers = metrics.get("observers")
    if not observers:
        return None
    rows = [_row(name, entry) for name, entry in observers.items()]
    kept = [i for i in range(len(_HEAD)) if any(row[i] != "–" for row in rows)]
    caption = "Certificates. “As it runs”: one bound for the observer with its state re-lifted at every step, for any unit. Deployed: the row set off."
    emphasised = where(observers, metrics["study"].get("deployed"))
    table = Table([_HEAD[i] for i in kept], [[row[i] for i in kept] for row in rows], caption, emphasised=emphasised)
    return Section("synthesis", "Synthesis", [_TEXT], [table, *_remarks(run)], ["synthesis", "certificates"])


def _remarks(run: RunFolder) -> list[Table]:
    """Reasons why there is no observer, or no certificate; observers with the same reason share a row."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for name, facts in run.observers_record["facts"].items():
        if facts.get("reason"):
            what = "no observer" if facts.get("status") == "failed" else "no certificate"
            reason = "; ".join(dict.fromkeys(facts["reason"].split("; ")))
            reasons.setdefault((what, reason), []).append(observer_label(name))
    rows: list[Cells] = [["; ".join(names), Cell(what, strong=True), reason] for (what, reason), names in reasons.items()]
    return [Table(["observer", "", "reason"], rows, "What could not be designed or certified, and why", prose=True)] if rows else []


def _row(name: str, entry: Mapping[str, Any]) -> list[Cell | str]:
    relift, radius = entry.get("relift_certified"), entry.get("spectral_radius_max")
    # A baseline's own optimum bounds its own objective, not the worst case.
    bound = entry.get("lower_bound") if split_observer(name)[1] not in BASELINES else None
    return [
        observer_label(name),
        entry.get("status") or "–",
        "–" if entry.get("order") is None else str(entry["order"]),
        number(entry.get("worst_case_h2"), 4),
        number(bound or None, 4),
        number(entry.get("gap_percent") if bound else None),
        "–" if radius is None else Cell(minus(radius_text(radius)), strong=radius >= 1),
        "–" if relift is None else f"gain {number(entry.get('relift_gain'))}" if relift else "no certificate",
        number(entry.get("solve_s")),
    ]
