"""Places a grid of axes in one pass: what every row and column needs around it is measured once. Imported when something is drawn.

Matplotlib's constrained layout measures twice, which is half of the time of a figure. The grid is drawn near its final size from the
start, so that ticks, and with them the margins, hardly change.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.layout_engine import LayoutEngine

_EDGE_IN, _GAP_IN = 0.04, 0.08


class OnePass(LayoutEngine):
    """Margins of rows and columns around axes of given relative sizes.

    Parameters
    ----------
    axes : ndarray of Axes, shape (rows, columns)
    top_in : float
        Height that is kept free above, inches.
    widths, heights : sequence of float or None
        Relative sizes; alike by default.
    """

    _adjust_compatible = False
    _colorbar_gridspec = False

    def __init__(self, axes: npt.NDArray[Any], top_in: float, widths: Sequence[float] | None, heights: Sequence[float] | None) -> None:
        super().__init__()
        self._axes, self._top_in = axes, top_in
        rows, columns = axes.shape
        self._widths = np.ones(columns) if widths is None else np.asarray(widths, float)
        self._heights = np.ones(rows) if heights is None else np.asarray(heights, float)

    def execute(self, fig: Figure) -> None:
        """Measure and place."""
        need = np.array([[_margins(panel) for panel in row] for row in self._axes]) / fig.dpi  # (row, column, side), inches
        left, right = need[..., 0].max(axis=0), need[..., 1].max(axis=0)
        bottom, top = need[..., 2].max(axis=1), need[..., 3].max(axis=1)
        width, height = fig.get_size_inches()
        x, wide = _place(width, left, right, self._widths)
        y, high = _place(height - self._top_in, top, bottom, self._heights)  # from the top
        for i, row in enumerate(self._axes):
            for j, panel in enumerate(row):
                place = (x[j] / width, 1 - (self._top_in + y[i] + high[i]) / height, wide[j] / width, high[i] / height)
                panel._set_position(place)


def _margins(panel: Any) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of what is drawn around an axes, pixels."""
    around, inside = panel.get_tightbbox(for_layout_only=True), panel.bbox
    if around is None:
        return 0.0, 0.0, 0.0, 0.0
    return inside.x0 - around.x0, around.x1 - inside.x1, inside.y0 - around.y0, around.y1 - inside.y1


def _place(total: float, before: Any, after: Any, shares: Any) -> tuple[Any, Any]:
    """Return starts and lengths of cells with margins before and after them that fill a length."""
    room = total - before.sum() - after.sum() - 2 * _EDGE_IN - _GAP_IN * (len(shares) - 1)
    lengths = max(room, 0.1) * shares / shares.sum()
    ends = _EDGE_IN + np.cumsum(before + lengths + after) + _GAP_IN * np.arange(len(shares))
    return ends - after - lengths, lengths
