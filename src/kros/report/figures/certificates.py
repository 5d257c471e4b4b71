"""Certified worst case of every observer against the lower bound.

Needs: observers with their facts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from ..canvas import grid
from ..names import observer_label, observer_look
from ..run_folder import NotShownError, RunFolder
from ..theme import Tone
from .drawing import Drawing
from .observer_rows import plain_log_ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAME, TITLE = "certificates", "Certified worst cases"


def draw(run: RunFolder) -> Drawing:
    """Draw one row an observer."""
    facts: Mapping[str, Mapping[str, float | None]] = run.observers_record["facts"]
    certified = {n: float(v) for n in run.observer_names if (v := facts.get(n, {}).get("worst_case_h2")) is not None}
    if not certified:
        raise NotShownError("no observer has a certificate")
    bounds = {n: s.lower_bound for n, s in run.syntheses.items() if n in certified and s.bounded_in_h2}
    figure, axes = grid(1, 1, 0.3 * len(certified) + 0.7, legend_rows=0)
    draw_certificates(axes[0, 0], certified, bounds, run.deployed)
    return Drawing(
        figure,
        "Disc: certified H2 norm of the error for every unit in the uncertain set, channels over their largest values. Tick: lower bound, where one is known; "
        "no correction filter can bring the disc to its left. Smaller is better, and comparable within one model.",
    )


def draw_certificates(axes: Axes, certified: Mapping[str, float], bounds: Mapping[str, float | None], deployed: str | None) -> None:
    """Draw discs, ticks and what lies between them, best on top."""
    order = sorted(certified, key=lambda n: -certified[n])
    for place, name in enumerate(order):
        colour, bound = observer_look(name).colour, bounds.get(name)
        if bound:
            axes.plot([bound, certified[name]], [place, place], color=colour, lw=1.5)
            axes.plot(bound, place, "|", ms=9, mew=1.8, color=Tone.INK.light)
        axes.plot(certified[name], place, "o", ms=5.5, color=colour)
    axes.set_xscale("log")
    plain_log_ticks(axes, [v for v in [*certified.values(), *bounds.values()] if v], most=7)
    axes.set_yticks(range(len(order)), [observer_label(n) for n in order])
    for label, name in zip(axes.get_yticklabels(), order, strict=True):
        label.set_fontweight("bold" if name == deployed else "normal")
    axes.set_ylim(-0.6, len(order) - 0.4)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("H2 norm of the error, worst case")
