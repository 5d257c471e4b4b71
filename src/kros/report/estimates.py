"""A plot of what `kros estimate` writes: estimates in their band, recorded channels behind them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..core import AnyArray
from .canvas import grid, legend, thin
from .files import printed
from .theme import DRAWING, Tone, style


def estimates_png(period_s: float, columns: Mapping[str, AnyArray], units: Mapping[str, str]) -> bytes:
    """Return a picture of the estimated states of an episode, a row each, from its columns by name."""
    with style():
        figure, panels = grid(len(units), 1, sharex=True)
        for panel, (name, unit) in zip(panels[:, 0], units.items(), strict=True):
            estimate, band = columns[f"{name}_hat"], columns[f"{name}_band"]
            time_s = period_s * np.arange(len(estimate))
            if name in columns:
                look = {"color": Tone.INK, "lw": DRAWING.broad, "alpha": DRAWING.shade}
                panel.plot(*thin(time_s, columns[name]), label="recorded", **look)
            panel.plot(*thin(time_s, estimate), color=Tone.BLUE, label="estimate")
            panel.fill_between(time_s, estimate - band, estimate + band, alpha=DRAWING.shade, lw=0, label="error band")
            panel.set_ylabel(f"{name} [{unit}]" if unit else name)
        panels[-1, 0].set_xlabel("time [s]")
        legend(panels[0, 0])
    return printed(figure, "png")
