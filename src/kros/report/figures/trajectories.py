"""Shared by the figures of signals in time: channel rows, windows at constant speed, zooms."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...data.population import Channel, Role
from ..canvas import thin
from ..names import Look, axis_label
from ..run_folder import RunFolder, Shown
from ..theme import Tone

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = npt.NDArray[Any]
Line = tuple[str, Array, Look]

TRUTH = Look(Tone.INK.light, weight=2.2, opacity=0.38)


def states(run: RunFolder) -> list[Channel]:
    """Return the state channels, in column order."""
    return [c for c in run.channels if c.role is Role.STATE]


def reference_columns(run: RunFolder) -> dict[str, int]:
    """Return for every state the input column that is its reference, by the name ``target_<state>``."""
    inputs = [c.name for c in run.channels if c.role is Role.INPUT]
    return {c.name: inputs.index(f"target_{c.name}") for c in states(run) if f"target_{c.name}" in inputs}


def zoom_s(run: RunFolder, shown: Shown) -> float:
    """Return the length of a zoom: some fifteen turns of a gearbox, for other plants an eighth of the episode."""
    return 0.3 if run.calibrated else float(f"{shown.time_s[-1] / 8:.1g}")


def steady_window(run: RunFolder, shown: Shown, length_s: float) -> slice:
    """Return a window at constant speed: in the longest stretch of the highest steady reference, else in the middle of the episode."""
    size = min(round(length_s / run.sample_period_s), len(shown.time_s))
    columns = reference_columns(run)
    speed = shown.inputs[:, columns["velocity"]] if "velocity" in columns else np.zeros(len(shown.time_s))
    start, stop = longest_steady(speed)
    middle = (start + stop) // 2 if stop - start > size // 2 else len(shown.time_s) // 2
    first = min(max(middle - size // 2, 0), len(shown.time_s) - size)
    return slice(first, first + size)


def longest_steady(speed: Array) -> tuple[int, int]:
    """Return first and last sample of the longest stretch within 2 % of the highest speed; (0, 0) where nothing moves."""
    runs = steady_stretches(speed)
    return max(runs, key=lambda r: r[1] - r[0], default=(0, 0))


def steady_stretches(speed: Array) -> list[tuple[int, int]]:
    """Return all stretches within 2 % of the highest speed, each of one direction."""
    top = float(np.max(np.abs(speed), initial=0.0))
    if top == 0:
        return []
    found = []
    for sign in (1, -1):
        steady = sign * speed > 0.98 * top
        edges = np.flatnonzero(np.diff(np.concatenate([[False], steady, [False]]).astype(np.int8)))
        found += list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
    return sorted(found)


def draw_lines(axes: Axes, time_s: Array, lines: Sequence[Line], window: slice | None = None, width: float = 1.1) -> None:
    """Draw lines over time, all of them or a window."""
    part = slice(None) if window is None else window
    for order, (label, values, look) in enumerate(lines):
        x, y = thin(time_s[part], _finite(values[part]))
        axes.plot(x, y, look.style, color=look.colour, alpha=look.opacity, label=label, lw=width * look.weight, zorder=2 + 0.1 * order)
    axes.set_xlim(time_s[part][0], time_s[part][-1])


def clip_to(axes: Axes, values: Array, margin: float = 0.35) -> None:
    """Keep the vertical axis near the true signal, so that a diverging line does not hide the others."""
    low, high = float(values.min()), float(values.max())
    room = margin * max(high - low, 1e-12)
    bottom, top = axes.get_ylim()
    axes.set_ylim(max(bottom, low - room), min(top, high + room))


def label_rows(axes: Iterable[Axes], channels: Sequence[Channel], prefix: str = "", suffix: str = "") -> None:
    """Label the vertical axes with channel and unit of measure."""
    for row, channel in zip(axes, channels, strict=True):
        row.locator_params(axis="y", nbins=4)
        text = axis_label(f"{prefix}{channel.name}{suffix}", channel.unit)
        row.set_ylabel(text.replace(" (", "\n("))


def hide_times(rows: Iterable[Axes]) -> None:
    """Drop the numbers of time axes that are repeated below."""
    for axes in rows:
        axes.tick_params(labelbottom=False)


def shade(axes: Axes, time_s: Array, window: slice) -> None:
    """Mark on an overview where its zoom lies."""
    axes.axvspan(time_s[window][0], time_s[window][-1], color=Tone.GRID.light, lw=0, zorder=0.5)


def _finite(values: Array) -> Array:
    return np.where(np.abs(values) < 1e6, values, np.nan)
