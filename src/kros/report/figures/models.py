"""Identified models: magnitude and phase of every unit, and correlations of one-step residuals."""

from __future__ import annotations

import numpy as np

from ...data import EpisodeBatch
from ...evaluate.validation import correlation
from ...identify import IdentifiedModels, ModelSet
from ...observer import one_step_residual
from ..canvas import Captioned, Figure, decibel, frequency_axis, grid, label_below, legend, lines_of_units, set_titles
from ..names import model_label, model_look, words
from ..run_folder import RunFolder
from ..theme import DRAWING, Tone
from .entries import short
from .episodes import shown_episode


def bode(run: RunFolder) -> Captioned:
    """Draw the Koopman models, or the linear ones where there are no others."""
    models = run.models[run.kinds[0]]
    text = f"{len(models.unit_ids)} {model_label(models.name)} models, every signal over its largest value."
    return bode_figure(models, run.nominal), text


def identified_bode(models: IdentifiedModels, model: str | None = None, condition: str | None = None) -> Figure:
    """Draw models of one kind, the first by default, in the condition that feeds synthesis or another."""
    return bode_figure(models.models(model, condition))


def bode_figure(models: ModelSet, nominal: str | None = None) -> Figure:
    """Draw magnitude beside phase, a row a state and a pair of columns an input; the unit `nominal` stands out."""
    freqs = models.frequencies(DRAWING.frequencies, decades=DRAWING.decades)
    response = models.scaled_responses(freqs)
    rows, inputs = min(response.shape[2], DRAWING.states), min(response.shape[3], 2)
    values = (decibel(response), np.degrees(np.unwrap(np.angle(response), axis=1)))
    figure, axes = grid(rows, 2 * inputs, sharex=True)
    for (i, j), panel in np.ndenumerate(axes):
        lines = values[j % 2][:, :, i, j // 2]
        lines_of_units(panel, freqs, lines, model_look(models.name).colour, f"{len(lines)} units", models.unit_ids)
        if nominal in models.unit_ids:
            panel.plot(freqs, lines[models.index(nominal)], color=Tone.INK, label=f"nominal, unit {nominal}")
        frequency_axis(panel, freqs)
        panel.locator_params(axis="y", nbins=4)
        panel.set_ylabel("" if j else short(models.lifting.names[i]))
    for j, panel in enumerate(axes[0]):
        panel.set_title(f"{words(models.inputs[j // 2])}:\n{'phase (°)' if j % 2 else 'magnitude (dB)'}")
    legend(axes[0, 0])
    return figure


def residuals_figure(
    models: IdentifiedModels, model: str | None = None, unit: str | None = None, condition: str | None = None
) -> Figure:
    """Draw the autocorrelation of one-step residuals, and their correlation with present and earlier inputs."""
    from scipy.special import ndtri

    key = shown_episode(models, unit, condition)
    batch = EpisodeBatch.read(models.population, [key], parameters=models.parameters)
    chosen, signals = models.models(model, condition), (batch.states, batch.inputs, batch.parameters)
    row, lifting = chosen.index(key.unit), chosen.lifting
    residual = one_step_residual(lifting, chosen.A[row], chosen.B[row], *signals)[:, 0]
    band = ndtri((1 + DRAWING.white) / 2) / np.sqrt(len(residual))
    inputs = batch.inputs[-len(residual) :, 0].T[: DRAWING.states]
    figure, axes = grid(min(lifting.n_states, DRAWING.states), 1 + len(inputs), sharex=True, sharey="col")
    for values, name, panels in zip(residual.T, lifting.states, axes, strict=False):
        for other, panel in zip((values, *inputs), panels, strict=True):
            lines = correlation(values, other, DRAWING.lags)
            panel.axhspan(-band, band, color=Tone.GRID, lw=0, label=f"{100 * DRAWING.white:g} % band of white noise")
            panel.vlines(
                np.arange(len(lines)), 0, lines, color=model_look(chosen.name).colour, label=model_label(chosen.name)
            )
        panels[0].set_ylabel(short(name))
    set_titles(axes[0], (f"residual with\n{short(name)}" for name in ("itself", *chosen.recorded_inputs)))
    label_below(axes[-1], "lag (samples)")
    legend(axes[0, 0])
    return figure
