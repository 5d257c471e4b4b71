"""An axis of units: their names as long as they can be read, else their count."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_READABLE = 48


def units_axis(axes: Axes, units: Sequence[str]) -> None:
    """Label the horizontal axis with units at 0, 1, 2, ..."""
    axes.set_xlim(-0.7, len(units) - 0.3)
    axes.grid(visible=False, axis="x")
    if len(units) <= _READABLE:
        axes.set_xticks(range(len(units)), units, rotation=90 if len(units) > 8 else 0, size=7)
        axes.set_xlabel("unit")
    else:
        axes.set_xlabel(f"{len(units)} units, in order")
