"""Random members of the certified set beside the certificate: a row an observer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...canvas import Array, Axes, Figure, grid, legend, name_rows
from ...names import observer_label, observer_look, split_observer
from ...run_folder import NotShownError, RunFolder
from ...theme import Tone

_BINS, _MOST, _HEIGHT = 40, 8, 0.62


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw histograms of the error over its bound, with the units' own models and the worst causal perturbation that a search found."""
    sets = {row["observer"]: row for row in run.disturbed.get("monte_carlo", {}).get("sets", [])}
    model = split_observer(run.deployed or "")[0]
    chosen = [n for n in sets if split_observer(n)[0] == model][:_MOST] or list(sets)[:_MOST]
    if not chosen:
        raise NotShownError("no member of an uncertain set was drawn: the study asks for none, or no observer is certified for one")
    order = sorted(chosen, key=lambda n: -sets[n]["bound"])
    figure, axes = grid(1, 1, 0.36 * len(order) + 0.75)
    panel, arrays = axes[0, 0], run.members
    for place, name in enumerate(order):
        _row(panel, place, sets[name], arrays[f"members/{name}"], arrays[f"units/{name}"], observer_look(name).colour)
        causal = run.observers_record["facts"].get(name, {}).get("causal_h2")
        if causal:
            panel.plot([causal / sets[name]["bound"]] * 2, [place, place + _HEIGHT], color=Tone.ORANGE.light, lw=1.6)
    panel.axvline(1, color=Tone.INK.light, lw=1.4, label="certified bound")
    panel.plot([], [], "|", ms=7, mew=1.0, color=Tone.INK.light, label="units")
    panel.plot([], [], color=Tone.ORANGE.light, lw=1.6, label="worst causal one found by search")
    panel.plot([], [], "s", ms=6, color=Tone.SOFT.light, alpha=0.45, label="random members")
    labels = [f"{observer_label(n)}\nlargest {100 * sets[n]['largest'] / sets[n]['bound']:.1f} % of the bound" for n in order]
    name_rows(panel, labels, order.index(run.deployed) if run.deployed in order else None, shift=0.25, size=7)
    panel.set_ylim(-0.25, len(order) - 0.1)
    panel.set_xlim(0, 1.04)
    panel.set_xlabel("H2 norm of the error over its certified bound")
    legend(figure, panel)
    return figure, (
        f"{sets[order[0]]['members']} random stable causal perturbations of norm up to one, constant and all-pass ones of several orders, in place of "
        "the contraction that the certificate allows: a histogram of every observer's error, over its own bound. Ticks below are the models of the "
        "population's units. None may lie right of one. Where noise makes most of an error, all machines have nearly the same."
    )


def _row(panel: Axes, place: int, row: Mapping[str, Any], members: Array, units: Array, colour: str) -> None:
    counts, edges = np.histogram(np.minimum(members / row["bound"], 1.0), bins=_BINS, range=(0, 1))  # quadrature may round up
    heights = _HEIGHT * counts / max(counts.max(), 1)
    panel.stairs(place + heights, edges, baseline=place, fill=True, color=colour, alpha=0.45)
    panel.plot(units / row["bound"], np.full(len(units), place - 0.09), "|", ms=5, mew=1.0, color=Tone.INK.light)
