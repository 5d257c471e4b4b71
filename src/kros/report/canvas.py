"""Blank figures and what is drawn on many of them: thinned lines, labels at line ends, legends, axes in decibels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from math import ceil, floor, log10
from typing import TYPE_CHECKING, Any, TypeAlias, cast
from urllib.parse import quote

import numpy as np
import numpy.typing as npt

from .names import RAISED
from .theme import WIDTH_IN, Tone

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes as Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure as Figure
else:  # for annotations alone: matplotlib is imported when something is drawn
    Artist = Axes = Figure = Any

Array: TypeAlias = npt.NDArray[Any]
_BUCKETS = 280  # pairs of points that a line across the page can show
_POINTS = 220  # of a frequency line
_LEGEND_IN = 0.21  # height of a row of a legend
_READABLE = 48  # units whose names fit on an axis


def grid(rows: int, columns: int, row_height_in: float, **options: Any) -> tuple[Figure, npt.NDArray[Any]]:
    """Return a figure in constrained layout and its axes, shape (rows, columns); `options` are those of `Figure.subplots`."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=0.05, h_pad=0.05, wspace=0.02, hspace=0.02)
    figure = Figure(figsize=(WIDTH_IN, rows * row_height_in + 0.06), layout=layout)
    ratios = {key: options.pop(key) for key in ("width_ratios", "height_ratios") if key in options}
    panels = figure.subplots(rows, columns, squeeze=False, **ratios, **options)
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            _copy_ticks(axis)
    return figure, panels


def _copy_ticks(axis: Axis) -> None:
    """Let an axis copy its first tick: each is five artists, and most of the time goes into looking up how they all look."""
    vars(axis).update(_get_tick=partial(_another_tick, axis), _copy_tick_props=_leave)


def _another_tick(axis: Any, major: bool) -> Any:
    known = axis.majorTicks if major else axis.minorTicks
    return _twin(known[0]) if known else type(axis)._get_tick(axis, major)


def _leave(*_: Any) -> None:
    """A copy has the properties of the first tick already."""


def _twin(tick: Any) -> Any:
    """A tick like another, to be put somewhere else."""
    parts = {name: _shallow(getattr(tick, name)) for name in ("tick1line", "tick2line", "gridline", "label1", "label2")}
    for name in ("label1", "label2"):
        parts[name].set_fontproperties(parts[name].get_fontproperties())  # its own, which may become bold
    return _shallow(tick, **parts)


def _shallow(artist: Any, **changed: Any) -> Any:
    found = object.__new__(type(artist))
    vars(found).update(vars(artist), **changed)
    return found


def settle(figure: Figure) -> None:
    """Lay a figure out once and for all; otherwise every file written from it does so again."""
    engine = figure.get_layout_engine()
    if engine is None:
        return
    renderer = cast(Any, figure)._get_renderer()  # one for all, which knows the texts that it has measured
    for axes in figure.axes:
        _measure_once(axes, renderer)
    engine.execute(figure)
    for axes in figure.axes:
        _draw_unmeasured(axes)
    figure.set_layout_engine(None)  # a placeholder, "none", would still draw everything twice
    for axes in figure.axes:
        del axes.get_tightbbox


def _measure_once(axes: Axes, renderer: Any) -> None:
    """Let an axes tell its size with ticks and labels from one measurement: the layout asks twice, and most of its time goes there."""
    from matplotlib.ticker import AutoLocator, FixedLocator
    from matplotlib.transforms import Bbox

    if not any(axes.get_title(where) for where in ("left", "center", "right")):
        axes.set_title("", y=1.0)  # else its place is found from all ticks, for nothing; so is a label's
    for axis in (axes.xaxis, axes.yaxis):
        if not axis.label.get_text():
            axis.set_label_coords(0, 0)
    whole = axes.get_tightbbox(renderer, for_layout_only=True)
    around = np.zeros(4) if whole is None else np.subtract(whole.extents, axes.bbox.extents)
    for axis in (axes.xaxis, axes.yaxis):
        if isinstance(axis.get_major_locator(), AutoLocator):
            axis.set_major_locator(FixedLocator(list(axis.get_majorticklocs())))
        if axis.label.get_text():
            _keep_label(axes, axis)
    vars(axes)["get_tightbbox"] = lambda *_, **__: Bbox(np.reshape(axes.bbox.extents + around, (2, 2)))


def _draw_unmeasured(axes: Axes) -> None:
    """Let an axes be drawn without measuring its tick labels again: with labels in place, they matter for a factor that stands beside an axis alone."""
    if any(axis.get_offset_text().get_text() for axis in (axes.xaxis, axes.yaxis)):
        return
    vars(axes)["_autotitlepos"] = False
    for axis in (axes.xaxis, axes.yaxis):
        vars(axis)["_get_ticklabel_bboxes"] = lambda *_: ([], [])


def _keep_label(axes: Axes, axis: Axis) -> None:
    """Leave an axis's label as far from the axes as it was measured; it would be found from all ticks of all axes beside it again."""
    from matplotlib.figure import Figure
    from matplotlib.transforms import ScaledTranslation, blended_transform_factory

    figure, place = axes.get_figure(root=True), axis.label.get_position()
    assert isinstance(figure, Figure)
    # one coordinate is a share of the axes, the other one a place on the figure, in dots
    if axis is axes.yaxis:
        beside = ScaledTranslation((place[0] - axes.bbox.x0) / figure.dpi, 0.0, figure.dpi_scale_trans)
        axis.set_label_coords(0.0, place[1], blended_transform_factory(axes.transAxes + beside, axes.transAxes))
    else:
        below = ScaledTranslation(0.0, (place[1] - axes.bbox.y0) / figure.dpi, figure.dpi_scale_trans)
        axis.set_label_coords(place[0], 0.0, blended_transform_factory(axes.transAxes, axes.transAxes + below))


def legend(figure: Figure, axes: Axes, columns: int | None = None) -> None:
    """Write a legend across the top of the figure, from one axes' labelled lines; one row, or as many as `columns` makes of them."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        columns = columns or len(handles)
        figure.set_figheight(figure.get_figheight() + _LEGEND_IN * ceil(len(handles) / columns))
        figure.legend(handles, labels, loc="outside upper left", ncols=columns, borderaxespad=0.3, borderpad=0.1)


def note(axes: Axes, text: str, at: tuple[float, float], offset: tuple[float, float] = (0, 0), **options: Any) -> None:
    """Write a small text at a place in shares of the axes (`xycoords` says otherwise), moved by an offset in points."""
    settings: dict[str, Any] = {"xycoords": "axes fraction", "size": 7.5} | options
    axes.annotate(text, at, xytext=offset, textcoords="offset points", **settings)


def thin(x: Array, y: Array, buckets: int = _BUCKETS) -> tuple[Array, Array]:
    """Return a line with fewer points that looks the same: smallest and largest value of every bucket, in their order."""
    size = len(y) // buckets
    if size < 3:
        return x, y
    kept = size * buckets
    blocks = y[:kept].reshape(buckets, size)
    first, second = np.sort(np.stack([blocks.argmin(axis=1), blocks.argmax(axis=1)]), axis=0)
    starts = np.arange(buckets) * size
    rows = np.concatenate([np.stack([starts + first, starts + second], axis=1).ravel(), np.arange(kept, len(y), size)])
    return x[rows], y[rows]


def thin_log(freqs_hz: Array, values: Array, points: int = _POINTS) -> tuple[Array, Array]:
    """Return a frequency line, shape (..., n), with at most so many logarithmically spaced points; peaks are kept."""
    if len(freqs_hz) <= points:
        return freqs_hz, values
    starts = np.unique(np.linspace(0, len(freqs_hz), points, endpoint=False).astype(int))
    return freqs_hz[starts], np.maximum.reduceat(values, starts, axis=-1)


def decibel(values: npt.ArrayLike) -> Array:
    """Return magnitudes in decibels; zero becomes NaN, which is not drawn."""
    magnitude = np.abs(np.asarray(values))
    return 20 * np.log10(np.where(magnitude > 0, magnitude, np.nan))


def line_over_shade(axes: Axes, freqs_hz: Array, line: Array, shade: Array, colour: str, style: str = "-") -> None:
    """Draw magnitudes over frequency in dB, above a broad light line of what they are compared with."""
    freqs, below = thin_log(freqs_hz, shade)
    axes.plot(freqs, decibel(below), color=colour, lw=3.2, alpha=0.3, solid_capstyle="butt")
    axes.plot(freqs, decibel(thin_log(freqs_hz, line)[1]), style, color=colour)


def lines_of_units(
    axes: Axes, freqs_hz: Array, lines: Array, colour: str, label: str, units: Sequence[str] = ()
) -> None:
    """Draw thin lines, shape (unit, frequency) in dB, a unit each, with their names; a unit without a residual is left out."""
    from matplotlib.collections import LineCollection

    kept = [k for k, line in enumerate(lines) if np.isfinite(line).any()]
    paths = [np.column_stack([freqs_hz, lines[k]]) for k in kept]
    drawn = axes.add_collection(LineCollection(paths, colors=colour, linewidths=0.6, alpha=0.35, label=label))
    if units:
        name_units(drawn, [units[k] for k in kept])


def name_units(drawn: Artist, units: Sequence[str]) -> None:
    """Name the units behind the lines or points of an artist, in their order: the page shows the one under the pointer."""
    drawn.set_gid("units-" + ",".join(quote(unit, safe="") for unit in units))


def frequency_axis(axes: Axes, freqs_hz: Array, label: str = "frequency (Hz)", most: int = 6) -> None:
    """Make the horizontal axis logarithmic over the frequencies, with at most `most` numbers."""
    positive = freqs_hz[freqs_hz > 0]
    limits = (float(positive[0]), float(positive[-1]))
    if (
        axes.get_xscale() != "log" or axes.get_xlim() != limits
    ):  # once for shared axes: each call goes through all of them
        axes.set_xscale("log")
        axes.set_xlim(*limits)
        _powers_of_ten(axes.xaxis, "{x:g}", most)
    axes.set_xlabel(label)


def logarithmic(axes: Axes, plain: bool = False) -> None:
    """Make the vertical axis logarithmic, with few ticks in powers of ten, in plain figures or as powers."""
    axes.set_yscale("log")
    _powers_of_ten(axes.yaxis, "{x:g}" if plain else lambda value, _: power_of_ten(value))


def _powers_of_ten(axis: Axis, formatter: Any, most: int = 6) -> None:
    """Number a logarithmic axis at powers of ten only, without mathematical text, which is slow to set."""
    from matplotlib.ticker import LogLocator, NullLocator

    axis.set_major_locator(LogLocator(numticks=most))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(formatter)


def power_of_ten(value: float) -> str:
    """Return a power of ten with its exponent raised, such as 10⁻³."""
    return f"10{str(round(log10(value))).translate(RAISED)}"


def log_ticks(low: float, high: float, most: int = 3) -> list[float]:
    """Return at most `most` round numbers between two positive ones, in the densest steps that allows it."""
    exponents = range(floor(log10(low)), ceil(log10(high)) + 1)
    for steps in ((1, 2, 5), (1, 3), (1,)):
        found = [s * 10.0**e for e in exponents for s in steps if low <= s * 10.0**e <= high]
        if len(found) <= most:
            return found
    return found[:: ceil(len(found) / most)]


def units_axis(axes: Axes, units: Sequence[str]) -> None:
    """Label the horizontal axis with units at 0, 1, 2, ...: their names as long as they can be read, else their count."""
    axes.set_xlim(-0.7, len(units) - 0.3)
    axes.grid(visible=False, axis="x")
    if len(units) <= _READABLE:
        axes.set_xticks(range(len(units)), units, rotation=90 if len(units) > 8 else 0, size=7)
        axes.set_xlabel("unit")
    else:
        axes.set_xlabel(f"{len(units)} units, in order")


def label_below(axes: Iterable[Axes], text: str = "frequency (Hz)") -> None:
    """Label the horizontal axes of a row."""
    for panel in axes:
        panel.set_xlabel(text)


def limit_decibels(axes: Axes, floor_db: float) -> None:
    """Show at most `floor_db` decibels below the highest line."""
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, high - floor_db), high)


def end_labels(axes: Axes, entries: Sequence[tuple[float, str, str]], spacing: float = 0.085) -> None:
    """Write labels at the right ends of lines, moved apart where they would overlap."""
    low, high = axes.get_ylim()
    shown = sorted(
        ((value - low) / (high - low), text, colour) for value, text, colour in entries if np.isfinite(value)
    )
    for place, (_, text, colour) in zip(spread([s[0] for s in shown], spacing), shown, strict=True):
        note(axes, text, (1, place), (4, 0), va="center", color=colour, annotation_clip=False)


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


def zero_line(axes: Axes) -> None:
    """Mark 0 dB."""
    axes.axhline(0, color=Tone.SOFT.light, lw=0.7)
