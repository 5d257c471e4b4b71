"""Magnitude of every unit's model from every input to every state.

Needs: models.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...identify import ModelSet
from ..canvas import decibel, frequency_axis, grid, legend, limit_decibels
from ..names import best_models, is_koopman, model_label, model_look
from ..run_folder import RunFolder
from ..theme import Tone
from .drawing import Drawing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME, TITLE = "models", "Models of all units"
Array = npt.NDArray[Any]
_POINTS = 140


def draw(run: RunFolder) -> Drawing:
    """Draw the Koopman models, or the linear ones where there are no others."""
    chosen = [n for n in best_models(run.models) if is_koopman(n)] or list(run.models)
    models = run.models[chosen[-1]]
    nominal = _nominal(run)
    figure = bode_figure(models, nominal)
    n = len(models.unit_ids)
    text = f"Frequency responses of all {n} {model_label(models.name)} models, every state over every input, each signal over its largest value."
    text += " The spread of the lines is what the uncertainty model has to cover."
    return Drawing(figure, text)


def _nominal(run: RunFolder) -> str | None:
    return str(run.choice["nominal"]) if run.has("uncertainty/choice.json") else None


def bode_figure(models: ModelSet, nominal: str | None = None) -> Figure:
    """Draw the magnitudes of all units, rows states and columns inputs.

    Parameters
    ----------
    models : ModelSet
    nominal : str, optional
        Unit that is drawn on top.
    """
    freqs = models.frequencies(_POINTS, decades=5)
    scale = models.input_scale / models.output_scale[:, None]
    magnitude = decibel(models.systems().frequency_response(freqs) * scale)
    _, _, rows, columns = magnitude.shape
    figure, axes = grid(rows, columns, 1.15 if rows > 2 else 1.8, sharex=True, sharey=True)
    for i in range(rows):
        for j in range(columns):
            _draw_panel(axes[i, j], freqs, magnitude[:, :, i, j], models, nominal)
        axes[i, 0].set_ylabel(f"{_short(models.lifting.names[i])}\n(dB)")
    for j, name in enumerate(models.inputs):
        axes[0, j].set_title(f"from {name.replace('_', ' ')}")
        frequency_axis(axes[-1, j], freqs)
    limit_decibels(axes[0, 0], 110)
    legend(figure, axes[0, 0])
    return figure


def _draw_panel(axes: Any, freqs: Array, lines: Array, models: ModelSet, nominal: str | None) -> None:
    from matplotlib.collections import LineCollection

    colour = model_look(models.name).colour
    path = [np.column_stack([freqs, line]) for line in lines]
    axes.add_collection(LineCollection(path, colors=colour, linewidths=0.6, alpha=0.35, label=f"{len(lines)} units"))
    axes.autoscale_view()
    if nominal in models.unit_ids:
        axes.plot(freqs, lines[models.index(nominal)], color=Tone.INK.light, lw=1.1, label=f"nominal, unit {nominal}")


def _short(name: str) -> str:
    return name if len(name) <= 14 else f"{name.partition('(')[0]}(…)"
