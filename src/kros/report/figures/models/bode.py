"""Magnitude of every unit's model from every input to every state."""

from __future__ import annotations

from ....identify import ModelSet
from ....identify.identified import IdentifiedModels
from ...canvas import Figure, decibel, frequency_axis, grid, legend, limit_decibels, lines_of_units
from ...names import best_models, is_koopman, model_label, model_look, shorten
from ...run_folder import RunFolder
from ...theme import Tone

_POINTS = 140


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw the Koopman models, or the linear ones where there are no others."""
    chosen = [n for n in best_models(run.models) if is_koopman(n)] or list(run.models)
    models = run.models[chosen[-1]]
    nominal = str(run.choice["nominal"]) if run.has("uncertainty/choice.json") else None
    text = (
        f"Frequency responses of all {len(models.unit_ids)} {model_label(models.name)} models, every state over every input, each signal over its largest "
        "value."
    )
    return bode_figure(models, nominal), text


def identified_figure(found: IdentifiedModels, kind: str | None = None, condition: str | None = None) -> Figure:
    """Draw the models of one kind, the first by default, in the condition that feeds synthesis or another."""
    return bode_figure(found.models(kind, condition))


def bode_figure(models: ModelSet, nominal: str | None = None) -> Figure:
    """Draw the magnitudes of all units, rows states and columns inputs; the unit `nominal` on top."""
    freqs = models.frequencies(_POINTS, decades=5)
    scale = models.input_scale / models.output_scale[:, None]
    magnitude = decibel(models.systems().frequency_response(freqs) * scale)
    _, _, rows, columns = magnitude.shape
    figure, axes = grid(rows, columns, 1.15 if rows > 2 else 1.8, sharex=True, sharey=True)
    for i, row in enumerate(axes):
        for j, panel in enumerate(row):
            lines = magnitude[:, :, i, j]
            lines_of_units(panel, freqs, lines, model_look(models.name).colour, f"{len(lines)} units", models.unit_ids)
            panel.autoscale_view()
            if nominal in models.unit_ids:
                panel.plot(
                    freqs, lines[models.index(nominal)], color=Tone.INK.light, lw=1.1, label=f"nominal, unit {nominal}"
                )
        name = models.lifting.names[i]
        row[0].set_ylabel(f"{name if len(name) <= 14 else shorten(name.partition('(')[0], 11) + '(…)'}\n(dB)")
    for panel, name in zip(axes[0], models.inputs, strict=True):
        panel.set_title(f"from {name.replace('_', ' ')}")
    for panel in axes[-1]:
        frequency_axis(panel, freqs)
    limit_decibels(axes[0, 0], 110)
    legend(figure, axes[0, 0])
    return figure
