"""Estimates of the paper's linear and Koopman observer for the nominal and the worst off-nominal unit (the paper's Figure 11).

Needs: the evaluation's kept episodes with observers.
"""

from __future__ import annotations

from dataclasses import replace

from ..run_folder import RunFolder
from .drawing import Drawing
from .observers_in_time import draw_pair, episodes
from .pairs import ABOUT_PAPER, require_paper_pair

NAME, TITLE = "observers_in_time_paper", "Estimates of the paper's observers"


def draw(run: RunFolder) -> Drawing:
    """Draw the paper's pair."""
    drawing = draw_pair(run, require_paper_pair(episodes(run)[0].observers))
    return replace(drawing, caption=f"{ABOUT_PAPER} {drawing.caption}")
