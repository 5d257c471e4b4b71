"""Estimation errors of the nominal unit in a condition that no model has seen: the pair that is handed over (as in the paper's Figure 13).

Needs: the evaluation's kept episodes in a second condition.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..canvas import grid, legend
from ..names import condition_label, deployed_pair, episode_title, observer_label, observer_look
from ..run_folder import NotShownError, RunFolder, Shown
from .drawing import Drawing
from .trajectories import Line, draw_lines, hide_times, label_rows, shade, states, steady_window, zoom_s

NAME, TITLE = "loaded", "Errors in the other condition"


def draw(run: RunFolder) -> Drawing:
    """Draw the pair that a study hands over."""
    return draw_pair(run, deployed_pair(list(loaded_episode(run).observers), run.deployed))


def loaded_episode(run: RunFolder) -> Shown:
    """Return the kept episode of the nominal unit in another condition."""
    shown = next((s for s in run.shown if s.key.condition != run.identify_on), None)
    if shown is None or not shown.observers:
        raise NotShownError("the recordings have one condition only")
    return shown


def draw_pair(run: RunFolder, names: Sequence[str]) -> Drawing:
    """Draw errors over the episode and over a zoom at constant speed."""
    shown, channels = loaded_episode(run), states(run)[:4]
    figure, axes = grid(len(channels), 2, 1.35, width_ratios=(1.3, 1))
    length_s = zoom_s(run, shown)
    window = steady_window(run, shown, length_s)
    for i, (full, zoom) in enumerate(axes):
        lines = errors_of(shown, names, i)
        draw_lines(full, shown.time_s, lines, width=0.9)
        draw_lines(zoom, shown.time_s, lines, window, width=1.3)
        shade(full, shown.time_s, window)
    hide_times(axes[:-1].ravel())
    figure.align_ylabels(axes[:, 0])
    label_rows(axes[:, 0], channels, suffix=" error")
    axes[0, 0].set_title(episode_title(shown.key))
    axes[0, 1].set_title(f"{length_s:g} s of it" + (" at constant speed" if run.calibrated else ""))
    for panel in axes[-1]:
        panel.set_xlabel("time (s)")
    legend(figure, axes[0, 0])
    return Drawing(figure, _caption(run, shown))


def errors_of(shown: Shown, names: Sequence[str], channel: int) -> list[Line]:
    """Return recorded minus estimated, a line an observer."""
    return [(observer_label(n), shown.states[:, channel] - shown.observers[n][:, channel], observer_look(n)) for n in names]


def _caption(run: RunFolder, shown: Shown) -> str:
    text = f"Recorded minus estimated, with models identified in {condition_label(run.identify_on)} only. "
    if any(c.name == "current" for c in states(run)) and shown.key.condition == "load":
        text += (
            "What is left of the current is the load's torque, in units of current: a slow wave as the load turns. Less "
            "oscillation on it is a better torque estimate."
        )
    return text
