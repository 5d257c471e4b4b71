"""What was designed, and how near it comes to what can be reached."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...core.linalg import radius_text
from ..content import Cell, Section, Table, where
from ..names import BASELINES, minus, number, observer_label, split_observer
from ..run_folder import RunFolder

_TEXT = (
    "An observer's error is driven by how a unit differs from the nominal model, and by measurement noise. The certified worst case bounds the error's H2 norm "
    "(its RMS for white inputs of unit range) for every member of the uncertain set, recomputed independently of the solver. The lower bound is what no "
    "correction of this kind can beat; the gap is the distance between design and lower bound. The spectral radius is that of the nominal loop and of the "
    "units' own poles; it must be below one, and says nothing about robustness."
)
_HEAD = (
    *("observer", "solution", "filter states", "worst case, plants", "lower bound", "gap (%)", "spectral radius"),
    "solved in (s)",
)


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the table of solutions, of columns in which something is known."""
    observers = metrics.get("observers")
    if not observers:
        return None
    rows = [_row(name, entry) for name, entry in observers.items()]
    kept = [i for i in range(len(_HEAD)) if any(row[i] != "–" for row in rows)]
    caption = "Solutions: “optimal” reaches its lower bound, “bounded” is apart from it by the gap. What is certified of each stands under Trust."
    emphasised = where(observers, metrics["study"].get("deployed"))
    table = Table([_HEAD[i] for i in kept], [[row[i] for i in kept] for row in rows], caption, emphasised=emphasised)
    return Section("synthesis", "Synthesis", [_TEXT], [table], ["synthesis"])


def _row(name: str, entry: Mapping[str, Any]) -> list[Cell | str]:
    radius, status = entry.get("spectral_radius_max"), entry.get("status") or "–"
    # A baseline's own optimum bounds its own objective, not the worst case.
    bound = entry.get("lower_bound") if split_observer(name)[1] not in BASELINES else None
    return [
        observer_label(name),
        "bounded" if status == "certified" else status,
        "–" if entry.get("order") is None else str(entry["order"]),
        number(entry.get("worst_case_h2"), 4),
        number(bound or None, 4),
        number(entry.get("gap_percent") if bound else None),
        "–" if radius is None else Cell(minus(radius_text(radius)), strong=radius >= 1),
        number(entry.get("solve_s")),
    ]
