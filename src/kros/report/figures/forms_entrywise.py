"""Bounds of the residuals' entries for all six forms (the paper's Figure 7, entry by entry).

Needs: uncertain models, models.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...identify import ModelSet
from ...uncertainty import Form, UncertainModel, residual
from ..canvas import decibel, frequency_axis, grid
from ..names import best_models, form_label, model_label
from ..run_folder import NotShownError, RunFolder
from ..theme import Tone
from .drawing import Drawing
from .forms import FORM_TONES, window

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAME, TITLE = "forms_entrywise", "Six uncertainty forms, entry by entry"
Array = npt.NDArray[Any]
_POINTS = 120


def draw(run: RunFolder) -> Drawing:
    """Draw a row a model, a column a form."""
    chosen = {n: run.uncertain[n] for n in best_models(run.uncertain) if n in run.models}
    if not chosen:
        raise NotShownError("no models have been identified yet")
    bounds = {n: entry_bounds(model, run.models[n]) for n, model in chosen.items()}
    text = (
        "Thin: largest magnitude of each entry over all units, for the nominal unit that suits each form best. Thick: largest singular value, which bounds "
        "all directions at once and lies above every entry. Reading entries alone takes a form for smaller than it is."
    )
    return Drawing(entrywise_forms_figure(chosen, bounds), text)


def entry_bounds(model: UncertainModel, models: ModelSet) -> dict[Form, tuple[Array, Array]]:
    """Return frequencies and largest magnitudes of entries, shape (frequency, p', m'), of every form with its own nominal."""
    freqs = model.freqs_hz[:: max(1, len(model.freqs_hz) // _POINTS)]
    G = models.systems(model.unit_ids).frequency_response(freqs) * models.input_scale / models.output_scale[:, None]
    own = model.scaled_nominal().frequency_response(freqs)
    found = {}
    for form in model.bounds:
        nominal = model.nominals[form]
        G0 = own if form is model.form or nominal not in model.unit_ids else G[model.unit_ids.index(nominal)]
        found[form] = (freqs, np.abs(residual(form, G0, G)).max(axis=0))
    return found


def entrywise_forms_figure(models: Mapping[str, UncertainModel], bounds: Mapping[str, Mapping[Form, tuple[Array, Array]]]) -> Figure:
    """Draw entries of every form below the largest singular value.

    Parameters
    ----------
    models : mapping of name to UncertainModel
    bounds : mapping of name to mapping of Form to (frequencies, magnitudes)
    """
    figure, axes = grid(len(models), len(Form), 1.75, legend_rows=0, sharex=True, sharey="row")
    for row, (name, model) in zip(axes, models.items(), strict=True):
        for panel, form in zip(row, model.bounds, strict=True):
            freqs, entries = bounds[name][form]
            panel.plot(freqs, decibel(entries).reshape(len(freqs), -1), color=FORM_TONES[form].light, lw=0.8, alpha=0.9)
            panel.plot(model.freqs_hz, decibel(model.bounds[form]), color=FORM_TONES[form].light, lw=3, alpha=0.3)
            panel.axhline(0, color=Tone.SOFT.light, lw=0.7)
            frequency_axis(panel, model.freqs_hz, "", 4)
        row[0].set_ylim(*window(model))
        row[0].set_ylabel(f"{model_label(name)}\nlargest entry (dB)")
    for panel, form in zip(axes[0], next(iter(models.values())).bounds, strict=True):
        panel.set_title(form_label(form.value).replace(" ", "\n"))
    for panel in axes[-1]:
        panel.set_xlabel("frequency (Hz)")
    return figure
