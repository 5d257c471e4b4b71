"""What the prior of the refined models costs and brings: accuracy on held-out training episodes against uncertainty."""

from __future__ import annotations

import numpy as np

from ....identify.refine import RefinedModels
from ...canvas import Axes, Figure, grid, legend, note
from ...names import model_label, model_look, number
from ...run_folder import RunFolder
from ...theme import Tone

_APART_DB = 3.0  # labels nearer than this would overlap


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one panel a hidden state, one line a kind of model, one point a strength of the prior."""
    refined = run.refined
    states = next(iter(run.models.values())).lifting.states
    hidden = [states.index(name) for name in run.hidden_states]
    figure, axes = grid(1, len(hidden), 2.3)
    for panel, state in zip(axes[0], hidden, strict=True):
        for name, found in refined.items():
            _line(panel, name, found, state)
        panel.set_title(states[state].replace("_", " "))
        panel.set_xlabel("peak residual (dB)")
        panel.margins(0.12)
        panel.set_ylim(bottom=0)
    axes[0, 0].set_ylabel("free-run error (%)")
    legend(figure, axes[0, 0])
    chosen = "; ".join(f"{model_label(name)}: {number(found.strength)}" for name, found in refined.items())
    return figure, (
        "Refined models at each strength of the prior that holds them near the model of the whole population: median free-run error over held-out "
        "training episodes, against the largest residual (inverse input multiplicative) within the population. The strongest prior stands at the "
        f"left of each line; the one chosen is filled ({chosen}). Dashed: the population's one model used on every unit."
    )


def _line(panel: Axes, name: str, found: RefinedModels, state: int) -> None:
    rows = [row for row in found.trade_off if np.isfinite(row.strength) and np.isfinite(row.peak_db)]
    colour = model_look(name).colour
    x, y = [row.peak_db for row in rows], [row.held_out_percent[state] for row in rows]
    panel.plot(x, y, "o-", color=colour, mfc="none", ms=4, lw=1.0, label=model_label(name))
    labelled = -np.inf
    for row in rows:
        place = (row.peak_db, row.held_out_percent[state])
        if row.strength == found.strength:
            panel.plot(*place, "o", color=colour, ms=6)
        if row.peak_db - labelled > _APART_DB:
            note(panel, f"{row.strength:g}", place, (0, 5), xycoords="data", ha="center", size=7, color=Tone.SOFT.light)
            labelled = row.peak_db
    for row in found.trade_off:
        if np.isinf(row.strength):
            panel.axhline(row.held_out_percent[state], color=colour, lw=0.9, ls="--")
