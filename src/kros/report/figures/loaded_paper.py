"""Estimation errors of the paper's pair of observers in a condition that no model has seen (the paper's Figure 13).

Needs: the evaluation's kept episodes in a second condition.
"""

from __future__ import annotations

from dataclasses import replace

from ..run_folder import RunFolder
from .drawing import Drawing
from .loaded import draw_pair, loaded_episode
from .pairs import ABOUT_PAPER, require_paper_pair

NAME, TITLE = "loaded_paper", "Errors of the paper's observers in the other condition"


def draw(run: RunFolder) -> Drawing:
    """Draw the paper's pair."""
    drawing = draw_pair(run, require_paper_pair(loaded_episode(run).observers))
    return replace(drawing, caption=f"{ABOUT_PAPER} {drawing.caption}")
