"""Shared by charts with a row for every observer and a panel for every channel: how rows are ordered and named, and axes of errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..canvas import Array, Axes, Figure, fit_log_axis, grid, label_below, name_rows, note
from ..error_tables import ErrorCell
from ..names import observer_label
from ..theme import Tone


def best_last(cells: Mapping[str, Mapping[str, ErrorCell]], channels: Sequence[str]) -> list[str]:
    """Return observers in the order of rows from below: the best on top, those that diverged at the bottom."""
    smallest = {c: min((m for own in cells.values() if c in own and (m := own[c].mean)), default=1.0) for c in channels}

    def behind(observer: str) -> float:
        found = {c: cells[observer][c].mean for c in channels if c in cells[observer]}
        logarithms = [np.log(m / smallest[c]) for c, m in found.items() if m]
        return float(np.mean(logarithms)) if logarithms and len(logarithms) == len(found) else np.inf

    return sorted(cells, key=lambda observer: -behind(observer))


def row_panels(channels: Sequence[str], order: Sequence[str], deployed: str | None) -> tuple[Figure, Array]:
    """Return a figure and its panels; the deployed observer in bold."""
    figure, axes = grid(1, len(channels), 0.27 * len(order) + 0.75, sharey=True)
    for panel, channel in zip(axes[0], channels, strict=True):
        panel.set_title(channel.replace("_", " "))
        panel.grid(visible=False, axis="y")
    label_below(axes[0], "error (% of the largest value)" if len(channels) < 3 else "error (% of the\nlargest value)")
    name_rows(axes[0, 0], [observer_label(o) for o in order], order.index(deployed) if deployed in order else None)
    return figure, axes[0]


def say_diverged(axes: Axes, place: int) -> None:
    """Say so in a row."""
    note(axes, "diverged", (0.98, place), xycoords=("axes fraction", "data"), ha="right", va="center", size=7, color=Tone.SOFT.light)


def keep_comparable(axes: Axes, values: Sequence[float]) -> None:
    """Fit a logarithmic axis; values ten thousand times the smallest are cut, as they differ from the rest in kind."""
    positive = [v for v in values if v > 0]
    if positive:
        fit_log_axis(axes, [v for v in positive if v <= 1e4 * min(positive)])
