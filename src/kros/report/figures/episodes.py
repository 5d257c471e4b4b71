"""Signals in time: recorded and estimated values, errors, and their spectra."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...core import AnyArray, ConfigError, frozen
from ...data import Channel, Role
from ...evaluate import fit_percent
from ...evaluate.errors import error_spectrum
from ...evaluate.held_out import HeldOut
from ...identify import IdentifiedModels
from ...observer import Sensors
from ..canvas import Axes, Captioned, Figure, frequency_axis, grid, label_below, legend, logarithmic, set_titles
from ..names import (
    Look,
    condition_label,
    episode_title,
    in_condition,
    is_koopman,
    joined,
    linear_first,
    model_label,
    model_look,
    number,
    observer_label,
    observer_look,
    observer_pair,
    published,
    readable_unit,
    squared,
    words,
)
from ..run_folder import NotShownError, RunFolder, Shown
from ..theme import DRAWING, Tone

Lines = Mapping[str, tuple[AnyArray, Look]]
TRUTH = Look(Tone.INK, weight=2, opacity=DRAWING.shade)
_PAPER = "The paper's observers: mixed H2-H∞ synthesis on models of EDMD. "


@frozen
class Block:
    """One episode in a figure: its title, what is drawn beside the recorded signals, and of which states."""

    title: str
    shown: Shown
    lines: Lines  # values, shape (n_samples, n), by label
    states: Sequence[int]
    truth: str = "recorded"  # what the states are called


def free_run(run: RunFolder) -> Captioned:
    """Draw the simulation of a held-out episode of the nominal unit (the paper's Figures 5 and 6)."""
    shown = run.shown[0]
    if not shown.models:
        raise NotShownError("no model was simulated on the episode that is shown")
    lines = {model_label(n): (values, model_look(n)) for n, values in linear_first(shown.models).items()}
    text = "Simulation from the first recorded state with the recorded inputs, without measurements."
    return _figure(run, [Block(episode_title(shown.key), shown, lines, range(len(run.states)))], text)


def estimates(run: RunFolder, paper: bool = False) -> Captioned:
    """Draw estimates for the nominal and the worst off-nominal unit (the paper's Figures 11 and 12)."""
    shown = [s for s in run.shown if s.key.condition == run.facts.identify_on][:2]
    known, states = shown[0].observers, range(len(run.states)) if paper else run.hidden
    names = observer_pair(published(known)) if paper else observer_pair(known, run.deployed)
    if not names:
        reason = "the paper's observers are designed with identify.refine = false alone"
        raise NotShownError(reason if paper else "no observer was run on the episodes that are shown")
    blocks = [
        _observed(f"{role}: unit {one.key.unit}, episode {one.key.episode}", one, names, states)
        for role, one in zip(("nominal", "worst off-nominal"), shown, strict=False)
    ]
    measured = joined([words(c.name) for c in run.states if c.measured])
    text = f"{_PAPER if paper else ''}Estimated from {measured} and inputs; errors are recorded minus estimated values."
    return _figure(run, blocks, text)


def other_condition(run: RunFolder) -> Captioned:
    """Draw the paper's observers, or the deployed one, in a condition that no model has seen (Figures 13 and 14)."""
    shown = next((s for s in run.shown if s.key.condition != run.facts.identify_on), None)
    if shown is None or not shown.observers:
        raise NotShownError("the recordings have one condition only")
    pair = observer_pair(published(shown.observers))
    names = pair or observer_pair(shown.observers, run.deployed)
    text = _PAPER if pair else ""
    text += f"Designed in “{condition_label(run.facts.identify_on)}” alone; errors are recorded minus estimated values."
    return _figure(run, [_observed(episode_title(shown.key), shown, names, range(len(run.states)))], text)


def paper_estimates(run: RunFolder) -> Captioned:
    """Draw estimates of the paper's observers."""
    return estimates(run, paper=True)


def load_torque(run: RunFolder) -> Captioned:
    """Draw estimates of the load on an episode, a row a way to estimate."""
    content, blocks = run.evaluation.get("load_torque"), []
    if content is None:
        raise NotShownError("this study declares no load; set load.moment")
    shown = Shown.load(run.folder / "load")
    for way, label in {"load": "load state", "current": "error of the recorded current"}.items():
        estimates = {n: values for n, values in shown.observers.items() if n.endswith(f"/{way}")}
        lines = {model_label(n.partition("/")[0]): (values, model_look(n)) for n, values in estimates.items()}
        blocks += [Block(label, shown, lines, [0], "declared load")] if lines else []
    parts = [f"{r['observer']} {r['error_percent']:.0f} % of the load" for r in content["rows"]]
    text = f"Unit {shown.key.unit}{in_condition(shown.key.condition)}, in units of current. Errors below 5 Hz over all "
    text += f"units whose load was not known: {'; '.join(parts)}."
    return blocks_figure([Channel("load", Role.STATE)], blocks), text


def _observed(title: str, shown: Shown, names: Sequence[str], states: Sequence[int]) -> Block:
    return Block(title, shown, {observer_label(n): (shown.observers[n], observer_look(n)) for n in names}, states)


def _figure(run: RunFolder, blocks: Sequence[Block], text: str) -> Captioned:
    """Return the figure of some episodes of a run and its caption."""
    blocks = [replace(block, states=block.states[: DRAWING.states]) for block in blocks]
    band_hz = run.evaluation["band_hz"]
    text += " Shaded: the band around the gearbox frequency at top speed." if band_hz else ""
    return blocks_figure(run.channels, blocks, band_hz), text


def blocks_figure(
    channels: Sequence[Channel], blocks: Sequence[Block], band_hz: Sequence[float] | None = None
) -> Figure:
    """Draw a row a state: the episode, a part of it, the error over time, and its power spectral density."""
    figure, axes = grid(sum(len(block.states) for block in blocks), 4)
    first = 0
    for block in blocks:
        panels = axes[first : first + len(block.states)]
        first += len(block.states)
        for row, i in zip(panels, block.states, strict=True):
            _draw_state(row, block, i)
            row[3].set_ylabel(f"{squared(channels[i].unit)}/Hz", size="small")
            if band_hz is not None:
                row[3].axvspan(*band_hz, color=Tone.GRID, lw=0, zorder=0.5)
        label_rows(panels[:, 0], [channels[i] for i in block.states])
        for panel in panels[:-1, :3].ravel():
            panel.tick_params(labelbottom=False)
        label_below(panels[-1, :3], "time (s)")
        set_titles(panels[0, [0, 2, 3]], (block.title, "error", "PSD of the error"))
    figure.align_ylabels(axes[:, 0])
    legend(axes[0, 0])
    return figure


def _draw_state(row: Sequence[Axes], block: Block, i: int) -> None:
    """Draw one state of an episode in four panels."""
    shown, window = block.shown, window_of(block.shown)
    time_s, recorded = shown.time_s, shown.states[:, i].astype(float)
    start = int(DRAWING.settled * len(recorded))
    for panel, part in ((row[0], slice(None)), (row[1], window)):
        draw_line(panel, time_s[part], recorded[part], TRUTH, block.truth)
        for label, (values, look) in block.lines.items():
            draw_line(panel, time_s[part], _inside(values[part, i], recorded), look, label)
    row[0].axvspan(*time_s[window][[0, -1]], color=Tone.GRID, lw=0, zorder=0.5)
    for values, look in block.lines.values():
        error = recorded - values[:, i].astype(float)
        if np.abs(error).max() < DRAWING.diverged * np.ptp(recorded):
            draw_line(row[2], time_s[start:], error[start:], look)
            freqs, density = error_spectrum(error, shown.sample_period_s)
            row[3].plot(freqs[1:], density[1:], look.style, color=look.colour)
            frequency_axis(row[3], freqs)
    logarithmic(row[3])


def _inside(values: AnyArray, recorded: AnyArray) -> AnyArray:
    """Return values; those outside the range of the recorded signal with a margin become NaN, which ends a line."""
    room = np.ptp(recorded) / 2
    return np.where((values >= recorded.min() - room) & (values <= recorded.max() + room), values, np.nan)


def draw_line(axes: Axes, time_s: AnyArray, values: AnyArray, look: Look, label: str | None = None) -> None:
    """Draw a line over time, in front of earlier ones."""
    axes.plot(time_s, values, look.style, color=look.colour, alpha=look.opacity, label=label, lw=look.weight)
    axes.set_xlim(time_s[0], time_s[-1])


def label_rows(axes: Iterable[Axes], channels: Sequence[Channel]) -> None:
    """Label the vertical axes with channel and unit of measure."""
    for row, channel in zip(axes, channels, strict=True):
        row.locator_params(axis="y", nbins=4)
        lines = textwrap.wrap(words(channel.name), DRAWING.label, max_lines=2, placeholder="…")
        unit = readable_unit(channel.unit)
        row.set_ylabel("\n".join([*lines, f"({unit})" if unit else ""]).strip())


def window_of(shown: Shown) -> slice:
    """Return a window that begins where the last input is largest, as a reference of speed is at constant speed."""
    samples = len(shown.states)
    size = max(int(DRAWING.zoom * samples), 2)
    begin = min(int(np.abs(shown.inputs[:, -1]).argmax()), samples - size)
    return slice(begin, begin + size)


def episode_of(
    models: IdentifiedModels, unit: str | None, condition: str | None, sensor: Sensors | None = None
) -> HeldOut:
    """Return the first held-out episode, else a training one, of a unit or of the pooled ones."""
    facts, where = models.facts, condition or models.facts.identify_on
    units = [u for u in models.models(models.edmd_kinds[0], condition).unit_ids if unit or u in facts.pooled]
    keys = [k for part in ("test", "train") for k in facts.keys(part, unit, where) if k.unit in units]
    if not keys:
        raise ConfigError(f"Plot: unit {unit!r} has no episode in condition {where!r} with a model; name another one.")
    first = tuple(keys[:1])
    return HeldOut(models.population, first, models.parameters, first, sensor or {})


def compare_figure(
    models: IdentifiedModels, model: str | None = None, unit: str | None = None, condition: str | None = None
) -> Figure:
    """Draw simulations from the first recorded states beside the recording, with their fit in percent."""
    episode = episode_of(models, unit, condition)
    names = [model] if model else sorted(models.edmd_kinds if condition else models.kinds, key=is_koopman)
    (key,), states = episode.keys, models.population.read_parts(episode.keys[0])[0]
    runs = [episode.models(models.models(name, condition)).shown[key] for name in names]
    lines = {model_label(name): (values, model_look(name)) for name, values in zip(names, runs, strict=True)}
    figure = _episode_figure(episode, lines)
    figure.axes[0].set_title(f"{episode_title(key)}\n")  # above the fits, which stand beside it
    for panel, *percent in zip(figure.axes[1::4], *(fit_percent(values, states) for values in runs), strict=True):
        panel.set_title(f"fit {joined([number(value) for value in percent])} %")
    return figure


def design_figure(
    design: Any, models: IdentifiedModels | None = None, unit: str | None = None, condition: str | None = None
) -> Figure:
    """Draw estimates of a design, or of an observer, on a held-out episode of a unit behind its models."""
    if models is None:
        raise ConfigError("Plot of a design: give models= the identified models, whose recordings it runs on.")
    observer = getattr(design, "observer", design)
    episode = episode_of(models, unit, condition, observer.sensor)
    (outcome,) = episode.observers([observer])
    return _episode_figure(
        episode, {observer_label(observer.name): (outcome.shown[episode.keys[0]], observer_look(observer.name))}
    )


def _episode_figure(episode: HeldOut, lines: Lines) -> Figure:
    """Draw all states of one episode beside what was estimated or simulated."""
    (key,), population = episode.keys, episode.population
    shown = Shown(key, population.sample_period_s, *population.read_parts(key))
    block = Block(episode_title(key), shown, lines, range(len(population.states)))
    return blocks_figure(population.channels, [block])
