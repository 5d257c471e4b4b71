"""Bounds of the residuals' entries for all six forms (the paper's Figure 7, entry by entry)."""

from __future__ import annotations

import numpy as np

from ....identify import ModelSet
from ....uncertainty import Form, UncertainModel, residual
from ...canvas import Array, Figure, decibel, frequency_axis, grid, label_below, zero_line
from ...names import best_models, form_label, model_label
from ...run_folder import NotShownError, RunFolder
from .forms import FORM_TONES, window

_POINTS = 120


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw a row a model, a column a form."""
    chosen = {n: run.uncertain[n] for n in best_models(run.uncertain) if n in run.models}
    if not chosen:
        raise NotShownError("no models have been identified yet")
    bounds = {n: entry_bounds(model, run.models[n]) for n, model in chosen.items()}
    text = (
        "Thin: largest magnitude of each entry over all units, for the nominal unit that suits each form best. Thick: largest singular value, which bounds "
        "all directions at once and lies above every entry. Entries alone make a form look smaller than it is."
    )
    figure, axes = grid(len(chosen), len(Form), 1.75, sharex=True, sharey="row")
    for row, (name, model) in zip(axes, chosen.items(), strict=True):
        for panel, form in zip(row, model.bounds, strict=True):
            freqs, entries = bounds[name][form]
            panel.plot(freqs, decibel(entries).reshape(len(freqs), -1), color=FORM_TONES[form].light, lw=0.8, alpha=0.9)
            panel.plot(model.freqs_hz, decibel(model.bounds[form]), color=FORM_TONES[form].light, lw=3, alpha=0.3)
            zero_line(panel)
            frequency_axis(panel, model.freqs_hz, "", 4)
        row[0].set_ylim(*window(model))
        row[0].set_ylabel(f"{model_label(name)}\nlargest entry (dB)")
    for panel, form in zip(axes[0], next(iter(chosen.values())).bounds, strict=True):
        panel.set_title(form_label(form.value).replace(" ", "\n"))
    label_below(axes[-1])
    return figure, text


def entry_bounds(model: UncertainModel, models: ModelSet) -> dict[Form, tuple[Array, Array]]:
    """Return frequencies and largest magnitudes of entries, shape (frequency, p', m'), of every form with its own nominal."""
    freqs = model.freqs_hz[:: max(1, len(model.freqs_hz) // _POINTS)]
    G = models.scaled_responses(freqs, model.unit_ids)
    own = model.scaled_nominal().frequency_response(freqs)
    found = {}
    for form in model.bounds:
        nominal = model.nominals[form]
        G0 = own if form is model.form or nominal not in model.unit_ids else G[model.unit_ids.index(nominal)]
        found[form] = (freqs, np.abs(residual(form, G0, G)).max(axis=0))
    return found
