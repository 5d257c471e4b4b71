"""Blank figures and what is drawn on many of them: labels at line ends, legends, axes in decibels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import ceil, floor, log10
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core import AnyArray, ArrayLike, Record
from .names import RAISED
from .theme import DRAWING, Tone

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure as Figure
else:  # for annotations alone: matplotlib is imported when something is drawn
    Axes = Figure = Any

Captioned = tuple[Figure, str]  # a figure and more of its caption


def grid(rows: int, columns: int, **options: Any) -> tuple[Figure, AnyArray]:
    """Return a figure in constrained layout and its axes, shape (rows, columns); `options` as in `Figure.subplots`."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(wspace=0, hspace=0)
    figure = Figure(figsize=(DRAWING.width_in, DRAWING.row_in + (rows - 1) * DRAWING.more_rows_in), layout=layout)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def legend(axes: Axes, columns: int | None = None) -> None:
    """Write a legend across the top of the figure, from the labelled lines of one axes."""
    handles, labels = axes.get_legend_handles_labels()
    figure: Any = axes.figure
    if handles:
        columns = columns or (len(handles) if sum(map(len, labels)) < 100 else 2)
        figure.set_figheight(figure.get_figheight() + DRAWING.legend_in * ceil(len(handles) / columns))
        figure.legend(handles, labels, loc="outside upper left", ncols=columns)


def note(axes: Axes, text: str, at: tuple[float, float], offset: tuple[float, float], **options: Any) -> None:
    """Write a small text at a place in shares of the axes, moved by an offset in points."""
    settings: Record = {"xycoords": "axes fraction", "size": "small"} | options
    axes.annotate(text, at, xytext=offset, textcoords="offset points", **settings)


def dashed(axes: Axes, level: float) -> None:
    """Draw a level that values are compared with."""
    axes.axhline(level, color=Tone.SOFT, lw=DRAWING.thin, ls="--")


def decibel(values: ArrayLike) -> AnyArray:
    """Return magnitudes in decibels; zero becomes NaN, which is not drawn."""
    magnitude = np.abs(np.asarray(values))
    return 20 * np.log10(np.where(magnitude > 0, magnitude, np.nan))


def lines_of_units(axes: Axes, x: AnyArray, lines: AnyArray, colour: str, label: str) -> None:
    """Draw thin lines, shape (unit, x), a unit each; a unit without values is left out."""
    from matplotlib.collections import LineCollection

    paths = [np.column_stack([x, line]) for line in lines if np.isfinite(line).any()]
    thin = LineCollection(paths, colors=colour, linewidths=DRAWING.thin, alpha=DRAWING.shade, label=label)
    axes.add_collection(thin)
    axes.autoscale_view()


def frequency_axis(axes: Axes, freqs_hz: AnyArray) -> None:
    """Make the horizontal axis logarithmic over the frequencies, with few numbers; below the last row it is named."""
    positive = freqs_hz[freqs_hz > 0]
    axes.set_xscale("log")
    axes.set_xlim(float(positive[0]), float(positive[-1]))
    _powers_of_ten(axes.xaxis, "{x:g}")
    if (place := axes.get_subplotspec()) and place.is_last_row():
        axes.set_xlabel("frequency (Hz)")


def logarithmic(axes: Axes) -> None:
    """Make the vertical axis logarithmic, with few powers of ten."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(10.0 ** floor(log10(low)), 10.0 ** ceil(log10(high)))
    _powers_of_ten(axes.yaxis, lambda value, _: f"10{str(round(log10(value))).translate(RAISED)}")


def _powers_of_ten(axis: Axis, formatter: Any) -> None:
    """Number a logarithmic axis at powers of ten only, without mathematical text, which is slow to set."""
    from matplotlib.ticker import LogLocator, NullLocator

    axis.set_major_locator(LogLocator(numticks=4))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(formatter)


def units_axis(axes: Axes, units: Sequence[str]) -> None:
    """Label the horizontal axis with units at 0, 1, 2, ...: their names as long as they fit, else their count."""
    axes.set_xlim(-0.5, len(units) - 0.5)
    axes.grid(visible=False, axis="x")
    if len(units) <= 60:
        axes.set_xticks(range(len(units)), units, rotation="vertical" if len(units) > 4 else "horizontal", size="small")
        axes.set_xlabel("unit")
    else:
        axes.set_xlabel(f"{len(units)} units, in order")


def set_titles(axes: Iterable[Axes], titles: Iterable[str]) -> None:
    """Write the titles of a row of panels."""
    for panel, title in zip(axes, titles, strict=False):
        panel.set_title(title)


def label_below(axes: Iterable[Axes], text: str) -> None:
    """Label the horizontal axes of a row."""
    for panel in axes:
        panel.set_xlabel(text)
