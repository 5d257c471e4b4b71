"""Certified worst case of every observer against the lower bound."""

from __future__ import annotations

from collections.abc import Mapping

from ...canvas import Figure, fit_log_axis, grid, name_rows
from ...names import observer_label, observer_look
from ...run_folder import NotShownError, RunFolder
from ...theme import Tone


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw discs, ticks and what lies between them, a row an observer, best on top."""
    facts: Mapping[str, Mapping[str, float | None]] = run.observers_record["facts"]
    certified = {n: float(v) for n in run.observers_record["names"] if (v := facts.get(n, {}).get("worst_case_h2")) is not None}
    if not certified:
        raise NotShownError("no observer has a certificate")
    bounds = {n: s.lower_bound for n, s in run.syntheses.items() if n in certified and s.bounded_in_h2}
    figure, axes = grid(1, 1, 0.3 * len(certified) + 0.7)
    panel, order = axes[0, 0], sorted(certified, key=lambda n: -certified[n])
    for place, name in enumerate(order):
        colour, bound = observer_look(name).colour, bounds.get(name)
        if bound:
            panel.plot([bound, certified[name]], [place, place], color=colour, lw=1.5)
            panel.plot(bound, place, "|", ms=9, mew=1.8, color=Tone.INK.light)
        panel.plot(certified[name], place, "o", ms=5.5, color=colour)
    fit_log_axis(panel, [v for v in [*certified.values(), *bounds.values()] if v], most=7)
    name_rows(panel, [observer_label(n) for n in order], order.index(run.deployed) if run.deployed in order else None)
    panel.set_xlabel("H2 norm of the error, worst case")
    return figure, (
        "Disc: certified H2 norm of the error for every unit in the uncertain set, channels over their largest values. Tick: lower bound, where one is known; "
        "no correction filter can bring the disc to its left. Smaller is better, and comparable within one model."
    )
