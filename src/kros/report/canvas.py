"""Blank figures and what is drawn on many of them: thinned lines, labels at line ends, legends, axes in decibels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .names import RAISED
from .theme import WIDTH_IN, Tone

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Array = npt.NDArray[Any]
_BUCKETS = 700  # pairs of points that a line across the page can show


def grid(rows: int, columns: int, row_height_in: float, *, legend_rows: int = 1, **options: Any) -> tuple[Figure, npt.NDArray[Any]]:
    """Return a figure with rows and columns of axes.

    Parameters
    ----------
    rows, columns : int
    row_height_in : float
    legend_rows : int
        Lines of legend above the axes, see `legend`.
    **options
        Passed to `Figure.subplots`.

    Returns
    -------
    figure : Figure
    axes : ndarray of Axes, shape (rows, columns)
    """
    from matplotlib.figure import Figure

    from .layout import OnePass

    top_in = 0.06 + 0.19 * legend_rows
    height = rows * row_height_in + top_in
    figure = Figure(figsize=(WIDTH_IN, height))
    figure.subplots_adjust(
        left=0.09, right=0.98, bottom=min(0.5 / height, 0.3), top=1 - min((top_in + 0.2) / height, 0.4), wspace=0.15, hspace=0.2
    )
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    figure.set_layout_engine(OnePass(axes, top_in, options.get("width_ratios"), options.get("height_ratios")))
    return figure, axes


def thin(x: Array, y: Array, buckets: int = _BUCKETS) -> tuple[Array, Array]:
    """Return a line with fewer points that looks the same: smallest and largest value of every bucket, in their order.

    Parameters
    ----------
    x, y : ndarray, shape (n,)
    buckets : int

    Returns
    -------
    x, y : ndarray, shape (at most 2 * buckets + the rest,)
    """
    size = len(y) // buckets
    if size < 3:
        return x, y
    kept = size * buckets
    blocks = y[:kept].reshape(buckets, size)
    first, second = np.sort(np.stack([blocks.argmin(axis=1), blocks.argmax(axis=1)]), axis=0)
    starts = np.arange(buckets) * size
    rows = np.concatenate([np.stack([starts + first, starts + second], axis=1).ravel(), np.arange(kept, len(y), size)])
    return x[rows], y[rows]


def thin_log(freqs_hz: Array, values: Array, points: int = 220) -> tuple[Array, Array]:
    """Return a frequency line with fewer, logarithmically spaced points; peaks are kept.

    Parameters
    ----------
    freqs_hz : ndarray, shape (n,), Hz
    values : ndarray, shape (..., n)
    points : int
        Most points that are left.

    Returns
    -------
    freqs_hz : ndarray, shape (m,)
    values : ndarray, shape (..., m)
    """
    if len(freqs_hz) <= points:
        return freqs_hz, values
    starts = np.unique(np.linspace(0, len(freqs_hz), points, endpoint=False).astype(int))
    return freqs_hz[starts], np.maximum.reduceat(values, starts, axis=-1)


def decibel(values: npt.ArrayLike) -> Array:
    """Return magnitudes in decibels; zero becomes NaN, which is not drawn."""
    magnitude = np.abs(np.asarray(values))
    return 20 * np.log10(np.where(magnitude > 0, magnitude, np.nan))


def frequency_axis(axes: Axes, freqs_hz: Array, label: str = "frequency (Hz)", most: int = 6) -> None:
    """Make the horizontal axis logarithmic over the frequencies, with at most `most` numbers."""
    positive = freqs_hz[freqs_hz > 0]
    limits = (float(positive[0]), float(positive[-1]))
    if axes.get_xscale() != "log" or axes.get_xlim() != limits:  # shared axes are told once: each call goes through all of them
        axes.set_xscale("log")
        axes.set_xlim(*limits)
        plain_powers(axes.xaxis, "{x:g}", most)
    axes.set_xlabel(label)


def logarithmic(axes: Axes) -> None:
    """Make the vertical axis logarithmic, with few ticks in powers of ten."""
    axes.set_yscale("log")
    plain_powers(axes.yaxis, lambda value, _: power_of_ten(value))


def plain_powers(axis: Axis, formatter: Any, most: int = 6) -> None:
    """Tick a logarithmic axis at powers of ten only, numbered without mathematical text, which is slow to set."""
    from matplotlib.ticker import LogLocator, NullLocator

    axis.set_major_locator(LogLocator(numticks=most))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(formatter)


def power_of_ten(value: float) -> str:
    """Return a power of ten with its exponent raised, such as 10⁻³."""
    return f"10{str(round(float(np.log10(value)))).translate(RAISED)}"


def settle(figure: Figure) -> None:
    """Lay a figure out once and for all; otherwise every file written from it does so again."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)  # a placeholder, "none", would still draw everything twice


def limit_decibels(axes: Axes, floor_db: float = 90.0) -> None:
    """Show at most `floor_db` decibels below the highest line."""
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, high - floor_db), high)


def end_labels(axes: Axes, entries: Sequence[tuple[float, str, str]], spacing: float = 0.085) -> None:
    """Write labels at the right ends of lines, moved apart where they would overlap.

    Parameters
    ----------
    axes : Axes
        With its final limits and scale.
    entries : sequence of (value, text, colour)
        Value of the line at its right end, in data units.
    spacing : float
        Smallest distance, as a share of the axes' height.
    """
    shown = sorted((_fraction(axes, value), text, colour) for value, text, colour in entries if np.isfinite(value))
    for place, (_, text, colour) in zip(spread([s[0] for s in shown], spacing), shown, strict=True):
        axes.annotate(
            text,
            (1, place),
            xycoords="axes fraction",
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            color=colour,
            size=7.5,
            annotation_clip=False,
        )


def spread(places: Sequence[float], spacing: float) -> list[float]:
    """Move sorted places in [0, 1] apart to at least `spacing`, as little as a few passes allow."""
    moved = [min(max(p, 0.0), 1.0) for p in places]
    for _ in range(50):
        for i in range(1, len(moved)):
            lack = spacing - (moved[i] - moved[i - 1])
            if lack > 0:
                moved[i - 1] -= lack / 2
                moved[i] += lack / 2
    return moved


def _fraction(axes: Axes, value: float) -> float:
    low, high = axes.get_ylim()
    if axes.get_yscale() == "log":
        value, low, high = (float(np.log10(max(v, 1e-300))) for v in (value, low, high))
    return (value - low) / (high - low)


def legend(figure: Figure, axes: Axes, columns: int | None = None) -> None:
    """Write a legend across the top of the figure, from one axes' labelled lines; one row, or as many as `columns` makes of them."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        height = figure.get_figheight()
        figure.legend(
            handles, labels, loc="upper left", ncols=columns or len(handles), bbox_to_anchor=(0.0, 1.0 - 0.02 / height), borderaxespad=0.0
        )


def mark(axes: Axes, text: str) -> None:
    """Write a quiet note inside the axes, upper left."""
    axes.annotate(
        text, (0.0, 1.0), xycoords="axes fraction", xytext=(4, -3), textcoords="offset points", va="top", color=Tone.SOFT.light, size=7.5
    )
