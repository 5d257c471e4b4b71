"""Identified models: magnitude and phase of every unit."""

from __future__ import annotations

import numpy as np

from ...identify import IdentifiedModels, ModelSet
from ..canvas import Captioned, Figure, decibel, frequency_axis, grid, legend, lines_of_units
from ..names import model_label, model_look, words
from ..run_folder import RunFolder
from ..theme import DRAWING, Tone
from .entries import short


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
        lines_of_units(panel, freqs, lines, model_look(models.name).colour, f"{len(lines)} units")
        if nominal in models.unit_ids:
            panel.plot(freqs, lines[models.index(nominal)], color=Tone.INK, label=f"nominal, unit {nominal}")
        frequency_axis(panel, freqs)
        panel.locator_params(axis="y", nbins=4)
        panel.set_ylabel("" if j else short(models.lifting.names[i]))
    for j, panel in enumerate(axes[0]):
        panel.set_title(f"{words(models.inputs[j // 2])}:\n{'phase (°)' if j % 2 else 'magnitude (dB)'}")
    legend(axes[0, 0])
    return figure
