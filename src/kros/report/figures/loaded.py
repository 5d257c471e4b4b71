"""Estimation errors of the nominal unit in a condition that no model has seen (the paper's Figures 13 and 14).

Needs: the evaluation's kept episodes in a second condition.
"""

from __future__ import annotations

from ...evaluate.errors import error_spectrum
from ..canvas import grid, legend, logarithmic
from ..names import BASELINES, condition_label, episode_title, main_observers, observer_label, observer_look, split_observer
from ..run_folder import NotShownError, RunFolder, Shown
from .drawing import Drawing
from .spectra import band
from .trajectories import Line, draw_lines, hide_times, label_rows, states, steady_window, zoom_s

NAME, TITLE = "loaded", "Errors in the other condition"


def draw(run: RunFolder) -> Drawing:
    """Draw errors over the episode, over a zoom, and as spectra."""
    shown = next((s for s in run.shown if s.key.condition != run.identify_on), None)
    if shown is None or not shown.observers:
        raise NotShownError("the recordings have one condition only")
    names = _compared(list(shown.observers), run.deployed)
    channels = states(run)[:4]
    figure, axes = grid(len(channels), 3, 1.35, width_ratios=(1.5, 1, 1))
    length_s = zoom_s(run, shown)
    window, band_hz = steady_window(run, shown, length_s), run.evaluation.get("band_hz")
    for i, (full, zoom, spectrum) in enumerate(axes):
        lines = _errors(shown, names, i)
        draw_lines(full, shown.time_s, lines, width=0.9)
        draw_lines(zoom, shown.time_s, lines, window, width=1.3)
        for label, error, look in lines:
            freqs, density = error_spectrum(error.astype(float), run.sample_period_s)
            spectrum.plot(freqs[1:], density[1:], look.style, color=look.colour, label=label)
        logarithmic(spectrum)
        spectrum.set_xlim(0, min(3.5 * band_hz[1], freqs[-1]) if band_hz else freqs[-1])
        band(spectrum, band_hz)
    hide_times(axes[:-1].ravel())
    figure.align_ylabels(axes[:, 0])
    label_rows(axes[:, 0], channels, suffix=" error")
    axes[0, 0].set_title(episode_title(shown.key))
    axes[0, 1].set_title(f"{length_s:g} s of it")
    axes[0, 2].set_title("PSD, unit²/Hz")
    axes[-1, 0].set_xlabel("time (s)")
    axes[-1, 1].set_xlabel("time (s)")
    axes[-1, 2].set_xlabel("frequency (Hz)")
    legend(figure, axes[0, 0])
    return Drawing(figure, _caption(run, shown))


def _compared(observers: list[str], deployed: str | None) -> list[str]:
    """The observer that is handed over and its twin; beside a lonely one the tuned Kalman filters."""
    known = main_observers(observers, deployed)
    main = [n for n in known if split_observer(n)[1] != "open_loop"] or known
    robust = [n for n in main if split_observer(n)[1] not in BASELINES]
    return robust if len(robust) > 1 else main


def _errors(shown: Shown, names: list[str], channel: int) -> list[Line]:
    return [(observer_label(n), shown.states[:, channel] - shown.observers[n][:, channel], observer_look(n)) for n in names]


def _caption(run: RunFolder, shown: Shown) -> str:
    text = f"Recorded minus estimated, with models identified in {condition_label(run.identify_on)} only. "
    if any(c.name == "current" for c in states(run)) and shown.key.condition == "load":
        text += (
            "What is left of the current is the load's torque, in units of current: a slow wave as the load turns. Less "
            "oscillation on it is a better torque estimate."
        )
    return text
