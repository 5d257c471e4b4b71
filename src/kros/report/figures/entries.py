"""Residuals of every unit, entry by entry, with their bound and its fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...identify import ModelSet
from ...uncertainty import Form
from ...uncertainty.unit_residuals import UnitResiduals
from ..canvas import Figure, decibel, frequency_axis, grid, label_below, legend, lines_of_units, note, set_titles
from ..names import model_label, shorten, words
from ..run_folder import RunFolder
from ..theme import DRAWING, Tone

Names = tuple[Sequence[str], Sequence[str]]


def entry_names(form: Form, models: ModelSet) -> Names:
    """Return the signals behind the rows and the columns of a form's residual."""
    outputs, inputs = models.lifting.names, models.inputs
    return inputs if form.at_input else outputs, inputs if form.sees_input else outputs


def short(name: str) -> str:
    """Return a signal's name for a title; of a formula the outer function."""
    text = name if len(name) <= DRAWING.label or "(" not in name else f"{name.partition('(')[0]}(…)"
    return shorten(words(text), DRAWING.label)


def differing(residuals: UnitResiduals) -> list[int]:
    """Return the rows of the units that the weights bound, without the nominal one, whose residual is zero."""
    return [k for k in residuals.rows(inside=True) if residuals.unit_ids[k] != residuals.nominal_id]


def entries_figure(run: RunFolder, residuals_of: Mapping[str, UnitResiduals]) -> Figure:
    """Draw entries of all units with their bound and its fit, models one below the other."""
    sizes = [np.minimum(residuals.largest.shape[1:], DRAWING.states) for residuals in residuals_of.values()]
    figure, axes = grid(sum(p for p, _ in sizes), max(m for _, m in sizes), sharex=True, sharey=True)
    for panel in axes.ravel():
        panel.axis("off")
    top = 0
    for (name, residuals), (p, m) in zip(residuals_of.items(), sizes, strict=True):
        names = entry_names(residuals.form, run.models[name])
        _draw_block(axes[top : top + p, :m], residuals, names, model_label(name))
        top += p
    legend(axes[0, 0])
    return figure


def _draw_block(block: Any, residuals: UnitResiduals, names: Names, label: str) -> None:
    """Draw the entries of one kind of model; the first unit that is not covered is in the colour of alarm."""
    inside, freqs = differing(residuals), residuals.freqs_hz
    levels, bound, fitted = decibel(residuals.entries), decibel(residuals.largest), decibel(residuals.entry_weights)
    for i, row in enumerate(block):
        for j, panel in enumerate(row):
            panel.axis("on")
            lines_of_units(panel, freqs, levels[inside][..., i, j], Tone.BLUE, "units")
            panel.plot(freqs, bound[:, i, j], color=Tone.BLUE, lw=DRAWING.broad, alpha=DRAWING.shade, label="largest")
            panel.plot(freqs, fitted[:, i, j], color=Tone.INK, label="fitted weight")
            for unit in residuals.outside[:1]:
                line = levels[residuals.unit_ids.index(unit), ..., i, j]
                panel.plot(freqs, line, color=Tone.ALARM, label=f"unit {unit}")
            frequency_axis(panel, freqs)
            note(panel, f"order {residuals.entry_orders[i, j]}", (0, 0), (3, 3), color=Tone.SOFT)
        row[0].set_ylabel(f"to\n{short(names[0][i])}\n(dB)")
    set_titles(block[0], (f"{label},\nfrom {short(name)}" for name in names[1]))
    label_below(block[-1], "frequency (Hz)")
