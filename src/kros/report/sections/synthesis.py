"""What was designed, and what is certified about it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..content import Cell, Section, Table
from ..names import number, observer_label
from ..run_folder import RunFolder

_TEXT = (
    "An observer's error is driven by how a unit differs from the nominal model, and by measurement noise. The certified worst "
    "case bounds the error's H2 norm (its RMS "
    "for white inputs of unit range) for every member of the uncertain set, recomputed independently of the solver. The lower "
    "bound is what no correction of this kind "
    "can beat; the gap is the distance between design and lower bound. The spectral radius is that of the nominal loop and of the "
    "units' own poles; it must be below one, "
    "and says nothing about robustness."
)


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the certificate table."""
    observers = metrics.get("observers")
    if not observers:
        return None
    deployed = metrics["study"].get("deployed")
    rows = [_row(name, entry) for name, entry in observers.items()]
    head = [
        "observer",
        "status",
        "filter states",
        "certified worst case",
        "lower bound",
        "gap (%)",
        "spectral radius",
        "as it runs",
        "solved in (s)",
    ]
    emphasised = [i for i, name in enumerate(observers) if name == deployed]
    caption = "Certificates. “As it runs”: one bound for the observer with its state lifted anew at every step, for any unit. Handed over: the row set off."
    failed = [f"{observer_label(n)}: {e['reason']}" for n, e in observers.items() if e.get("reason")]
    return Section(
        "synthesis", "Synthesis", [_TEXT, *failed], [Table(head, rows, caption, emphasised=emphasised)], ["synthesis", "certificates"]
    )


def _row(name: str, entry: Mapping[str, Any]) -> list[Cell]:
    relift = entry.get("relift_certified")
    running = "–" if relift is None else (f"gain {number(entry.get('relift_gain'))}" if relift else "no certificate")
    radius = entry.get("spectral_radius_max")
    return [
        Cell(observer_label(name)),
        Cell(entry.get("status") or "–"),
        Cell("–" if entry.get("order") is None else str(entry["order"])),
        Cell(number(entry.get("worst_case_h2"), 4)),
        Cell(number(entry.get("lower_bound"), 4)),
        Cell(number(entry.get("gap_percent"))),
        Cell("–" if radius is None else f"{radius:.6f}", strong=radius is not None and radius >= 1),
        Cell(running),
        Cell(number(entry.get("solve_s"))),
    ]
