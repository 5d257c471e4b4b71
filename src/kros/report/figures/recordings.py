"""Figures of the recordings: signals, the tracking error's spectrum, and the phase of every unit."""

from collections.abc import Sequence

import numpy as np

from ...core import AnyArray, ConfigError
from ...data import Channel, Population
from ...evaluate.errors import error_spectrum
from ..canvas import Captioned, Figure, dashed, grid, label_below, legend, logarithmic, note, set_titles, units_axis
from ..names import Look, episode_title, minus, squared, words
from ..run_folder import NotShownError, RunFolder, Shown
from ..theme import DRAWING, Tone
from .episodes import draw_line, label_rows

_RECORDED, _REFERENCE = Look(Tone.INK), Look(Tone.GOLD, weight=3, opacity=0.5)


def recorded_episodes(run: RunFolder) -> list[Shown]:
    """Return one held-out episode of the nominal unit in every condition, the condition of the models first."""
    return [shown for shown in run.shown if shown.key.unit == run.shown[0].key.unit]


def signals(run: RunFolder) -> Captioned:
    """Draw one episode in at most two conditions, side by side."""
    shown = recorded_episodes(run)[:2]
    return recorded_figure(run.channels, shown), "The same unit in two conditions." if len(shown) == 2 else ""


def population_figure(population: Population, unit: str | None = None, condition: str | None = None) -> Figure:
    """Draw the first episode of a unit."""
    keys = population.keys(unit, condition)
    if not keys:
        raise ConfigError("Plot: the population has no such episodes; see its unit_ids and conditions.")
    shown = Shown(keys[0], population.sample_period_s, *population.read_parts(keys[0]))
    return recorded_figure(population.channels, [shown])


def recorded_figure(channels: Sequence[Channel], episodes: Sequence[Shown]) -> Figure:
    """Draw states and inputs of episodes, a column each; an input that is the reference of a state is behind it."""
    names = [channel.name for channel in channels]
    targets = {k: names.index(f"target_{name}") for k, name in enumerate(names) if f"target_{name}" in names}
    rows = [k for k in range(len(names)) if k not in targets.values()]
    figure, axes = grid(len(rows), len(episodes), sharey="row", sharex="col")
    for column, episode in zip(axes.T, episodes, strict=True):
        values = np.hstack([episode.states, episode.inputs])
        for panel, k in zip(column, rows, strict=True):
            if k in targets:
                draw_line(panel, episode.time_s, values[:, targets[k]], _REFERENCE, "reference")
            draw_line(panel, episode.time_s, values[:, k], _RECORDED, "recorded")
        column[0].set_title(episode_title(episode.key))
    label_rows(axes[:, 0], [channels[k] for k in rows])
    label_below(axes[-1], "time (s)")
    figure.align_ylabels(axes[:, 0])
    legend(axes[0, 0])
    return figure


def tracking_spectrum(run: RunFolder) -> Captioned:
    """Draw the spectrum of the tracking error at constant speed in every condition (the paper's Figure 4)."""
    spec, names, top = run.calibration.spec, [c.name for c in run.channels], 0.5 / run.sample_period_s
    figure, axes = grid(1, 1)
    panel, speed = axes[0, 0], 0.0
    for shown, tone in zip(recorded_episodes(run), (Tone.BLUE, Tone.GOLD, Tone.GREEN), strict=False):
        values = np.hstack([shown.states, shown.inputs]).astype(float)
        reference, measured = (values[:, names.index(name)] for name in (spec.reference, spec.measured))
        steady = steady_stretch(reference, round(spec.settle * len(reference)))
        freqs, density = error_spectrum((reference - measured)[steady], run.sample_period_s, DRAWING.segment)
        panel.plot(freqs[1:], density[1:], color=tone, label=episode_title(shown.key))
        speed = max(speed, float(np.abs(reference).max()))
    logarithmic(panel)
    frequency = spec.ratio * speed / (2 * np.pi)
    count = min(8, int(top / frequency))
    for place in frequency * np.arange(1, count + 1):
        panel.axvline(place, color=Tone.SOFT, lw=DRAWING.thin, ls=":", zorder=1)
        note(panel, f"{place:.0f} Hz", (place, 1), (3, -2), xycoords=("data", "axes fraction"), va="top")
    panel.set_xlim(0, min(top, (count + 0.5) * frequency))
    panel.set_xlabel("frequency (Hz)")
    unit = run.channels[names.index(spec.measured)].unit
    panel.set_ylabel(f"{spec.measured} error,\nPSD ({squared(unit)}/Hz)")
    legend(panel)
    text = f"{words(spec.reference)} minus {words(spec.measured)} at the highest speed. Dotted: {frequency:.3g} Hz, "
    return figure, text + f"which is {spec.ratio:g} times the speed, and its multiples."


def steady_stretch(speed: AnyArray, settle: int) -> slice:
    """Return the longest stretch within 2 % of the highest speed, without the samples in which the loop settles."""
    peak = speed[np.abs(speed).argmax()]
    fast = speed * peak >= 0.98 * peak**2  # in one direction
    longest = max(np.ma.clump_unmasked(np.ma.masked_where(~fast, speed)), key=lambda part: part.stop - part.start)
    if longest.stop - longest.start <= settle:
        raise NotShownError("no episode has a stretch of constant speed that is long enough")
    return slice(longest.start + settle, longest.stop)


def phase(run: RunFolder) -> Captioned:
    """Draw phase, lag and concentration of every unit (Appendix B); units that are set aside are drawn hollow."""
    calibration = run.calibration
    units, values = list(calibration.units), calibration.units.values()
    figure, axes = grid(1, 3)
    columns = np.array([(np.degrees(v.phase_rad), np.degrees(v.lag_rad), v.concentration) for v in values]).T
    inside = np.isin(units, run.facts.pooled)
    for column, panel in zip(columns, axes[0], strict=True):
        for chosen, face in ((inside, Tone.BLUE), (~inside, "none")):
            panel.plot(*np.nonzero(chosen), column[chosen], "o", ms=4, color=Tone.BLUE, mfc=face)
        units_axis(panel, units)
    set_titles(axes[0], ("phase (°)", "lag (°)", "concentration"))
    axes[0, 0].set_yticks([0, 180, 360])
    dashed(axes[0, 1], np.degrees(calibration.lag_rad))
    dashed(axes[0, 2], DRAWING.concentrated)
    lags = columns[1, inside]
    mean, low, high = (minus(f"{value:.0f}°") for value in (np.mean(lags), lags.min(), lags.max()))
    return figure, f"The lag of the loop is {mean} in the mean, from {low} to {high}."
