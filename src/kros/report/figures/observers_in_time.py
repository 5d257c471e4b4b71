"""Estimates of the observer that is handed over and its linear twin for the nominal and the worst off-nominal unit (as in the paper's Figure 11).

Needs: the evaluation's kept episodes with observers.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..canvas import grid, legend
from ..names import deployed_pair, is_koopman, observer_label, observer_look, shorten
from ..run_folder import NotShownError, RunFolder, Shown
from .drawing import Drawing
from .trajectories import TRUTH, clip_to, draw_lines, hide_times, label_rows, shade, states, steady_window, zoom_s

NAME, TITLE = "observers_in_time", "Estimates"
_ROWS = 3  # states of one unit


def draw(run: RunFolder) -> Drawing:
    """Draw the pair that a study hands over."""
    return draw_pair(run, deployed_pair(list(episodes(run)[0].observers), run.deployed))


def episodes(run: RunFolder) -> list[Shown]:
    """Return the kept episodes of the nominal and the worst off-nominal unit."""
    shown = [s for s in run.shown if s.key.condition == run.identify_on][:2]
    if not shown or not shown[0].observers:
        raise NotShownError("no observer was run on the episodes that are shown")
    return shown


def draw_pair(run: RunFolder, names: Sequence[str]) -> Drawing:
    """Draw full episodes on the left and a zoom at constant speed on the right, nominal above worst off-nominal."""
    shown, all_states = episodes(run), states(run)
    hidden_first = sorted(range(len(all_states)), key=lambda i: all_states[i].measured)
    rows = sorted(hidden_first[:_ROWS])
    channels = [all_states[i] for i in rows]
    figure, axes = grid(len(rows) * len(shown), 2, 1.15, width_ratios=(1.3, 1))
    for block, episode in enumerate(shown):
        length_s = zoom_s(run, episode)
        window = steady_window(run, episode, length_s)
        panels = axes[block * len(rows) : (block + 1) * len(rows)]
        for i, (full, zoom) in zip(rows, panels, strict=True):
            lines = [("recorded", episode.states[:, i], TRUTH)] + [
                (observer_label(n), episode.observers[n][:, i], observer_look(n)) for n in names
            ]
            draw_lines(full, episode.time_s, lines, width=0.9)
            draw_lines(zoom, episode.time_s, lines, window, width=1.4)
            clip_to(full, episode.states[:, i], 0.15)
            clip_to(zoom, episode.states[window, i], 1.0)
            shade(full, episode.time_s, window)
        label_rows(panels[:, 0], channels)
        hide_times(panels[:-1].ravel())
        role = "nominal" if block == 0 else "worst off-nominal"
        panels[0, 0].set_title(shorten(f"{role}: unit {episode.key.unit}, episode {episode.key.episode}", 46))
        panels[0, 1].set_title(f"{length_s:g} s of it" + (" at constant speed" if run.calibrated else ""))
    for panel in axes[-1]:
        panel.set_xlabel("time (s)")
    figure.align_ylabels(axes[:, 0])
    legend(figure, axes[0, 0])
    return Drawing(figure, _caption(run, names))


def _caption(run: RunFolder, names: Sequence[str]) -> str:
    measured = " and ".join(c.name for c in states(run) if c.measured)
    text = f"Estimates from {measured} alone, as recorded. "
    if run.calibrated and any(is_koopman(n) for n in names):
        text += "On the right, how much of the gearbox oscillation each of them follows. "
    return (
        text + "The start shows how fast an observer finds the true state: all begin at the first measurement with everything else at zero."
    )
