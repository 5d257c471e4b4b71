"""Estimation errors of the nominal unit of the paper's pair in a condition that no model has seen (the paper's Figure 13)."""

from __future__ import annotations

from ...canvas import Figure
from ...names import condition_label, episode_title
from ...run_folder import NotShownError, RunFolder, Shown
from ..episodes import Strip, overview_and_zoom, require_paper_pair
from .in_time import error_lines


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw errors over the episode and over a zoom at constant speed."""
    shown = other_episode(run)
    names, text = require_paper_pair(shown.observers)
    strips = [Strip(channel, error_lines(shown, names, i)) for i, channel in enumerate(run.states[:4])]
    text += f"Recorded minus estimated, with models identified in {condition_label(run.identify_on)} only. "
    if any(c.name == "current" for c in run.states) and shown.key.condition == "load":
        text += (
            "What is left of the current is the load's torque, in units of current: a slow wave as the load turns. Less "
            "oscillation on it is a better torque estimate."
        )
    return overview_and_zoom(run, [(episode_title(shown.key), shown, strips)], 1.35), text


def other_episode(run: RunFolder) -> Shown:
    """Return the kept episode of the nominal unit in another condition."""
    shown = next((s for s in run.shown if s.key.condition != run.identify_on), None)
    if shown is None or not shown.observers:
        raise NotShownError("the recordings have one condition only")
    return shown
