"""Recorded signals of one held-out episode in every condition, with the velocity error at constant speed."""

from __future__ import annotations

import numpy as np

from ....core.errors import ConfigError
from ....data.population import Population, Role
from ...canvas import Figure, grid, legend
from ...names import Look, axis_label, episode_title
from ...run_folder import RunFolder
from ...theme import Tone
from ..episodes import (
    clip_to,
    draw_lines,
    hide_times,
    label_rows,
    recorded_episodes,
    reference_columns,
    shade,
    steady_window,
)

_RECORDED, _REFERENCE = Look(Tone.INK.light), Look(Tone.GOLD.light)
_ZOOM = 400  # samples


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one episode of the nominal unit in at most two conditions, side by side."""
    shown = recorded_episodes(run)[:2]
    channels, references = run.states[:5], reference_columns(run)
    zoomed = "velocity" if "velocity" in references else next(iter(references), None)
    figure, axes = grid(len(channels) + (zoomed is not None), len(shown), 1.15, sharey="row")
    for column, episode in zip(axes.T, shown, strict=True):
        window = steady_window(run, episode, _ZOOM)
        for i, channel in enumerate(channels):
            lines = [("recorded", episode.states[:, i], _RECORDED)]
            if channel.name in references:
                lines.append(("reference", episode.inputs[:, references[channel.name]], _REFERENCE))
            draw_lines(column[i], episode.time_s, lines, width=1.0)
            if zoomed is not None:
                shade(column[i], episode.time_s, window)
        column[0].set_title(episode_title(episode.key))
        column[len(channels) - 1].set_xlabel("time (s)")
        hide_times(column[: len(channels) - 1])
        if zoomed is not None:
            i = [c.name for c in channels].index(zoomed)
            error = episode.inputs[:, references[zoomed]] - episode.states[:, i]
            draw_lines(column[-1], episode.time_s, [("error", error, Look(Tone.BLUE.light))], window)
            column[-1].set_xlabel("time (s), shaded window above")
    label_rows(axes[: len(channels), 0], channels)
    if zoomed is not None:
        unit = next(c.unit for c in channels if c.name == zoomed)
        axes[-1, 0].set_ylabel(axis_label(f"{zoomed} error", unit).replace(" (", "\n("))
    clip_to(axes[0, 0], shown[0].states[:, 0], 0.35)
    figure.align_ylabels(axes[:, 0])
    legend(figure, axes[0, 0])
    text = "A held-out episode as recorded" + (", in both conditions of the same unit." if len(shown) == 2 else ".")
    if zoomed is not None:
        text += f" Bottom: reference minus recorded {zoomed} at constant speed"
        text += (
            ", where the gearbox shows as a steady oscillation that no linear model can produce."
            if run.calibrated
            else "."
        )
    return figure, text


def population_figure(population: Population) -> Figure:
    """Draw all channels of the first episode of a population, inputs in gold."""
    if not population.episodes:
        raise ConfigError("Plot: the population has no episodes; read some first.")
    key = population.episodes[0]
    values = population.read(key)
    figure, axes = grid(len(population.channels), 1, 1.1, sharex=True)
    for panel, channel, line in zip(axes[:, 0], population.channels, values.T, strict=True):
        look = _RECORDED if channel.role is Role.STATE else _REFERENCE
        draw_lines(panel, np.arange(len(values)) * population.sample_period_s, [(channel.name, line, look)], width=1.0)
    label_rows(axes[:, 0], population.channels)
    axes[0, 0].set_title(episode_title(key))
    axes[-1, 0].set_xlabel("time (s)")
    return figure
