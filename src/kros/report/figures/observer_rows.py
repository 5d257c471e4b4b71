"""Charts with a row for every observer and a panel for every channel: how rows are ordered and named, and axes of errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil, floor, log10
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from ..canvas import grid
from ..names import observer_label
from ..theme import Tone

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Cell(Protocol):
    """What a table knows of an observer and a channel."""

    @property
    def mean(self) -> float | None:
        """Mean error; None where the estimate diverged."""
        ...


def best_last(cells: Mapping[str, Mapping[str, Cell]], channels: Sequence[str]) -> list[str]:
    """Return observers in the order of rows from below: the best on top, those that diverged at the bottom.

    What counts is the mean logarithm of the errors over the smallest of their channel, so that observers of fewer channels have their place among the others.
    """
    smallest = {c: min((m for own in cells.values() if c in own and (m := own[c].mean)), default=1.0) for c in channels}

    def behind(observer: str) -> float:
        found = {c: cells[observer][c].mean for c in channels if c in cells[observer]}
        logarithms = [np.log(m / smallest[c]) for c, m in found.items() if m]
        return float(np.mean(logarithms)) if logarithms and len(logarithms) == len(found) else np.inf

    return sorted(cells, key=lambda observer: -behind(observer))


def row_panels(channels: Sequence[str], order: Sequence[str], deployed: str | None) -> tuple[Figure, npt.NDArray[Any]]:
    """Return a figure and its panels with logarithmic axes; the observer that is handed over in bold."""
    figure, axes = grid(1, len(channels), 0.36 * len(order) + 0.75, legend_rows=0, sharey=True)
    for panel, channel in zip(axes[0], channels, strict=True):
        panel.set_xscale("log")
        panel.set_title(channel.replace("_", " "))
        panel.set_xlabel("error (% of the largest value)")
        panel.grid(visible=False, axis="y")
    axes[0, 0].set_yticks(range(len(order)), [observer_label(o) for o in order])
    for label, observer in zip(axes[0, 0].get_yticklabels(), order, strict=True):
        label.set_fontweight("bold" if observer == deployed else "normal")
    axes[0, 0].set_ylim(-0.6, len(order) - 0.4)
    return figure, axes[0]


def say_diverged(axes: Axes, place: int) -> None:
    """Say so in a row."""
    axes.annotate("diverged", (0.98, place), xycoords=("axes fraction", "data"), ha="right", va="center", size=7, color=Tone.SOFT.light)


def keep_comparable(axes: Axes, values: Sequence[float]) -> None:
    """Cut values ten thousand times the smallest: they differ from the rest in kind."""
    positive = [v for v in values if v > 0]
    if positive:
        plain_log_ticks(axes, [v for v in positive if v <= 1e4 * min(positive)])


def plain_log_ticks(axes: Axes, values: Sequence[float], most: int = 3) -> None:
    """Fit a logarithmic axis around values and number it in plain figures, as many as there is room for."""
    from matplotlib.ticker import FixedLocator, NullLocator

    low, high = min(values) / 1.6, max(max(values) * 1.6, 4 * min(values))
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(FixedLocator(log_ticks(low, high, most)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())


def log_ticks(low: float, high: float, most: int = 3) -> list[float]:
    """Return at most `most` round numbers between two positive ones, in the densest steps that allows it."""
    exponents = range(floor(log10(low)), ceil(log10(high)) + 1)
    for steps in ((1, 2, 5), (1, 3), (1,)):
        found = [s * 10.0**e for e in exponents for s in steps if low <= s * 10.0**e <= high]
        if len(found) <= most:
            return found
    return found[:: ceil(len(found) / most)]
