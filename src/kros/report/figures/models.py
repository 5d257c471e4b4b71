"""Bode plots of the identified models: magnitude and phase of every unit."""

from __future__ import annotations

import numpy as np

from ...identify import ModelSet
from ...identify.identified import IdentifiedModels
from ..canvas import Figure, decibel, frequency_axis, grid, legend, lines_of_units
from ..names import model_label, model_look, words
from ..run_folder import RunFolder
from ..theme import DRAWING, Tone
from .entries import short


def bode(run: RunFolder) -> tuple[Figure, str]:
    """Draw the Koopman models, or the linear ones where there are no others."""
    models = run.models[run.kinds[0]]
    text = f"{len(models.unit_ids)} {model_label(models.name)} models, every signal over its largest value."
    return bode_figure(models, run.nominal), text


def identified_figure(models: IdentifiedModels, kind: str | None = None, condition: str | None = None) -> Figure:
    """Draw the models of one kind, the first by default, in the condition that feeds synthesis or another."""
    return bode_figure(models.models(kind, condition))


def bode_figure(models: ModelSet, nominal: str | None = None) -> Figure:
    """Draw magnitude beside phase, a row a state and a pair of columns an input; the unit `nominal` stands out."""
    freqs = models.frequencies(DRAWING.frequencies, decades=DRAWING.decades)
    response = models.systems().frequency_response(freqs) * (models.input_scale / models.output_scale[:, None])
    rows, inputs = min(response.shape[2], DRAWING.states), min(response.shape[3], 2)
    values = (decibel(response), np.degrees(np.unwrap(np.angle(response), axis=1)))
    figure, axes = grid(rows, 2 * inputs, sharex=True)
    for i, row in enumerate(axes):
        for j, panel in enumerate(row):
            lines = values[j % 2][:, :, i, j // 2]
            lines_of_units(panel, freqs, lines, model_look(models.name).colour, f"{len(lines)} units", models.unit_ids)
            if nominal in models.unit_ids:
                line = lines[models.index(nominal)]
                panel.plot(freqs, line, color=Tone.INK.light, label=f"nominal, unit {nominal}")
            frequency_axis(panel, freqs, "frequency (Hz)" if i == rows - 1 else "")
            panel.locator_params(axis="y", nbins=4)
        row[0].set_ylabel(short(models.lifting.names[i]))
    for j, panel in enumerate(axes[0]):
        panel.set_title(f"{words(models.inputs[j // 2])}:\n{'phase (°)' if j % 2 else 'magnitude (dB)'}")
    legend(figure, axes[0, 0])
    return figure
