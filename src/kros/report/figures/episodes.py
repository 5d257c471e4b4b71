"""Shared by the figures of signals in time: which episode, windows at constant speed, rows of channels with a zoom beside them."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from ...data.population import OUTLIERS, Channel, EpisodeKey, Role
from ..canvas import Array, Axes, Figure, grid, label_below, legend, thin
from ..names import Look, paper_pair, readable_unit, shorten
from ..run_folder import NotShownError, RunFolder, Shown
from ..theme import Tone

Line = tuple[str, Array, Look]

LINE = 14  # letters beside an axis of a strip


@dataclass(frozen=True)
class Strip:
    """Lines of one channel over time: near the first one, the recorded signal, in shares of its range; or errors, where that is None."""

    channel: Channel
    lines: Sequence[Line]
    near: float | None = None


TRUTH = Look(Tone.INK.light, weight=2.2, opacity=0.38)
_ABOUT_PAPER = "The paper's observers: mixed H2-H∞ synthesis, models of extended dynamic mode decomposition. "


def recorded_episodes(run: RunFolder) -> list[Shown]:
    """Return one held-out episode of one unit in every condition, the condition that was identified on first."""
    try:
        unit = run.shown[0].key.unit
        found = [s for s in run.shown if s.key.unit == unit]
    except NotShownError:
        groups = run.facts["groups"]
        unit = next((u for u, group in groups.items() if group != OUTLIERS), next(iter(groups)))
        keys = {
            key.condition: key for key in (EpisodeKey(*row) for row in reversed(run.facts["test"])) if key.unit == unit
        }
        found = [_read(run, key) for key in keys.values()]
    return sorted(found, key=lambda s: s.key.condition != run.identify_on)


def _read(run: RunFolder, key: EpisodeKey) -> Shown:
    states, inputs = run.population.read_parts(key)
    return Shown(key, np.arange(len(states)) * run.sample_period_s, states, inputs, {}, {})


def require_paper_pair(names: Iterable[str]) -> tuple[list[str], str]:
    """Return the paper's linear and Koopman observer, and a sentence about them; raises `NotShownError` where the study made neither."""
    found = paper_pair(names)
    if not found:
        reason = "this study has no observer of the paper's method; name mixed in synthesis.methods, and see why it failed where it did"
        raise NotShownError(reason)
    return found, _ABOUT_PAPER


def reference_columns(run: RunFolder) -> dict[str, int]:
    """Return for every state the input column that is its reference, by the name ``target_<state>``."""
    inputs = [c.name for c in run.channels if c.role is Role.INPUT]
    return {c.name: inputs.index(f"target_{c.name}") for c in run.states if f"target_{c.name}" in inputs}


def steady_window(run: RunFolder, shown: Shown, n_samples: int) -> slice:
    """Return a window at constant speed: in the longest stretch of the highest steady reference, else in the middle of the episode."""
    size = min(n_samples, len(shown.time_s))
    columns = reference_columns(run)
    speed = shown.inputs[:, columns["velocity"]] if "velocity" in columns else np.zeros(len(shown.time_s))
    start, stop = longest_steady(speed)
    middle = (start + stop) // 2 if stop - start > size // 2 else len(shown.time_s) // 2
    first = min(max(middle - size // 2, 0), len(shown.time_s) - size)
    return slice(first, first + size)


def longest_steady(speed: Array) -> tuple[int, int]:
    """Return first and last sample of the longest stretch within 2 % of the highest speed; (0, 0) where nothing moves."""
    return max(steady_stretches(speed), key=lambda r: r[1] - r[0], default=(0, 0))


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


def overview_and_zoom(run: RunFolder, blocks: Sequence[tuple[str, Shown, Sequence[Strip]]], height_in: float) -> Figure:
    """Draw whole episodes on the left and a zoom at constant speed on the right, one strip below the other."""
    figure, axes = grid(sum(len(strips) for _, _, strips in blocks), 2, height_in, width_ratios=(1.4, 1))
    first = 0
    for title, episode, strips in blocks:
        panels = axes[first : first + len(strips)]
        first += len(strips)
        # some fifteen turns of a gearbox, for other plants an eighth of the episode
        length_s = 300 * run.sample_period_s if run.calibrated else float(f"{episode.time_s[-1] / 8:.1g}")
        window = steady_window(run, episode, round(length_s / run.sample_period_s))
        for (full, zoom), strip in zip(panels, strips, strict=True):
            draw_lines(full, episode.time_s, strip.lines, width=0.9)
            draw_lines(zoom, episode.time_s, strip.lines, window, width=1.3)
            if strip.near is not None:
                clip_to(full, strip.lines[0][1], strip.near)
                clip_to(zoom, strip.lines[0][1][window], 1.0)
            else:
                _clip_start(full, strip.lines)
            shade(full, episode.time_s, window)
        label_rows(
            panels[:, 0],
            [strip.channel for strip in strips],
            [" error" if strip.near is None else "" for strip in strips],
        )
        hide_times(panels[:-1].ravel())
        panels[0, 0].set_title(title)
        panels[0, 1].set_title(f"{length_s:g} s of it" + (" at constant speed" if run.calibrated else ""))
    label_below(axes[-1], "time (s)")
    figure.align_ylabels(axes[:, 0])
    legend(figure, max(axes[:, 0], key=lambda panel: len(panel.get_legend_handles_labels()[0])))
    return figure


def _clip_start(axes: Axes, lines: Sequence[Line]) -> None:
    """Keep the axis of errors near what they are after the first tenth: at the start an observer knows nothing yet."""
    sizes = [np.abs(values[len(values) // 10 :]) for _, values, _ in lines]
    largest = max((float(size.max()) for size in sizes if np.isfinite(size).all() and size.max() < 1e6), default=0.0)
    if largest > 0:
        axes.set_ylim(-1.5 * largest, 1.5 * largest)


def draw_lines(
    axes: Axes, time_s: Array, lines: Sequence[Line], window: slice | None = None, width: float = 1.1
) -> None:
    """Draw lines over time, all of them or a window; what diverges is cut."""
    part = slice(None) if window is None else window
    for order, (label, values, look) in enumerate(lines):
        x, y = thin(time_s[part], np.where(np.abs(values[part]) < 1e6, values[part], np.nan))
        axes.plot(
            x,
            y,
            look.style,
            color=look.colour,
            alpha=look.opacity,
            label=label,
            lw=width * look.weight,
            zorder=2 + 0.1 * order,
        )
    axes.set_xlim(time_s[part][0], time_s[part][-1])


def clip_to(axes: Axes, values: Array, margin: float) -> None:
    """Keep the vertical axis near the true signal, so that a diverging line does not hide the others."""
    low, high = float(values.min()), float(values.max())
    room = margin * max(high - low, 1e-12)
    bottom, top = axes.get_ylim()
    axes.set_ylim(max(bottom, low - room), min(top, high + room))


def label_rows(axes: Iterable[Axes], channels: Sequence[Channel], suffixes: Iterable[str] = repeat("")) -> None:
    """Label the vertical axes with channel and unit of measure."""
    for row, channel, suffix in zip(axes, channels, suffixes):  # noqa: B905 - suffixes may go on for ever
        row.locator_params(axis="y", nbins=4)
        lines = textwrap.wrap(f"{channel.name}{suffix}".replace("_", " "), LINE, break_long_words=False)[:2]
        unit = readable_unit(channel.unit)
        row.set_ylabel("\n".join([*(shorten(line, LINE) for line in lines), *([f"({unit})"] if unit else [])]))


def hide_times(rows: Iterable[Axes]) -> None:
    """Drop the numbers of time axes that are repeated below."""
    for axes in rows:
        axes.tick_params(labelbottom=False)


def shade(axes: Axes, time_s: Array, window: slice) -> None:
    """Mark on an overview where its zoom lies."""
    axes.axvspan(time_s[window][0], time_s[window][-1], color=Tone.GRID.light, lw=0, zorder=0.5)
