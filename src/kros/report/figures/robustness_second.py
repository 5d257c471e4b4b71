"""Error against severity of the second state that is not measured.

Needs: disturbed runs.
"""

from __future__ import annotations

from ..run_folder import RunFolder
from .drawing import Drawing
from .robustness import draw_channel

NAME, TITLE = "robustness_second", "When measurements are worse, the second hidden state"


def draw(run: RunFolder) -> Drawing:
    """Draw one panel a disturbance, one line an observer."""
    return draw_channel(run, 1)
