"""Frequency responses: models of all units, and correction filters beside plant and weights."""

import numpy as np

from ...core import AnyArray, StateSpace, grouped
from ...design.task import split_name
from ...identify import IdentifiedModels, ModelSet
from ...synthesis.result import Injection, Synthesis
from ..canvas import Captioned, Figure, decibel, frequency_axis, grid, legend, lines_of_units
from ..names import label_of, method_look, model_label, model_look, words
from ..run_folder import NotShownError, RunFolder
from ..theme import DRAWING, Tone
from .uncertainty import short


def models(run: RunFolder) -> Captioned:
    """Draw the Koopman models, or the linear ones where there are no others."""
    chosen = run.models[run.kinds[0]]
    text = f"{len(chosen.unit_ids)} {model_label(chosen.name)} models, every signal over its largest value."
    return bode_figure(chosen, run.nominal), text


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


def filters(run: RunFolder) -> Captioned:
    """Draw largest singular values of plant, weights and filters, linear beside Koopman (the paper's Figure 10)."""
    robust = [n for n in run.syntheses if not label_of(n).baseline and split_name(n)[1] != "estimator"]
    if not robust:
        raise NotShownError("no robust observer has been synthesized")
    chosen = grouped(robust, lambda name: split_name(name)[0])
    figure, axes = grid(1, len(chosen), sharey=True)
    for panel, (name, observers) in zip(axes[0], chosen.items(), strict=True):
        models, weight = run.models[name], run.uncertain[name].weight
        freqs = models.frequencies(DRAWING.frequencies, decades=DRAWING.decades)
        curves: list[tuple[str, AnyArray, str, str]] = [
            ("plant G", models.scaled_responses(freqs, [str(run.nominal)])[0], Tone.GREY, "-"),
            ("W left", weight.left.frequency_response(freqs), Tone.GOLD, "-"),
            ("W right", weight.right.frequency_response(freqs), Tone.GREEN, "--"),
        ]
        for observer in observers:
            K, look = scaled_filter(run.syntheses[observer], models), method_look(observer)
            curves.append((f"K {label_of(observer).text}", K.frequency_response(freqs), look.colour, look.style))
        for label, response, colour, line in curves:
            size = decibel(np.linalg.matrix_norm(response, ord=2))
            if np.isfinite(size).any():  # not of a filter that is zero
                panel.plot(freqs, size, line, color=colour, label=label)
        panel.axhline(0, color=Tone.SOFT, lw=DRAWING.thin)
        frequency_axis(panel, freqs)
        panel.set_title(model_label(name))
    legend(max(axes[0], key=lambda panel: len(panel.lines)), 4)
    axes[0, 0].set_ylabel("largest singular value (dB)")
    return figure, "Every signal over its largest value. K maps the innovation to the correction."


def scaled_filter(synthesis: Synthesis, models: ModelSet) -> StateSpace:
    """Return the correction filter with innovation and correction over the largest values of their signals."""
    outside = models.input_scale if synthesis.injection is Injection.INPUT else models.output_scale
    return synthesis.controller.multiplied(1 / outside, models.output_scale[list(models.measured)])
