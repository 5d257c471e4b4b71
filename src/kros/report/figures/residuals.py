"""Shared by the figures of residuals of every unit: names of the entries, one panel an entry, ratios to the weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...identify import ModelSet
from ...uncertainty import Form, UncertainModel
from ...uncertainty.unit_residuals import UnitResiduals, unit_residuals
from ..canvas import Array, Axes, Figure, decibel, frequency_axis, grid, label_below, legend, lines_of_units, note
from ..names import model_label, shorten
from ..theme import Tone

Names = tuple[Sequence[str], Sequence[str]]
_FLOOR_DB = 80.0
_LOWEST_DB = -25.0  # of ratios: units that are far inside the weights say no more
_MOST = 4  # rows and columns of entries that are shown
_POINTS = 250
_OUTPUT_ROWS = (Form.ADDITIVE, Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE)
_OUTPUT_COLUMNS = (Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_ADDITIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE)


def entry_names(form: Form, models: ModelSet) -> Names:
    """Return the signals behind the rows and the columns of a form's residual."""
    outputs, inputs = models.lifting.names, models.inputs
    return outputs if form in _OUTPUT_ROWS else inputs, outputs if form in _OUTPUT_COLUMNS else inputs


def short(name: str) -> str:
    """Return a signal's name for a title; of a formula the outer function."""
    text = name if len(name) <= 16 else f"{name.partition('(')[0]}(…)" if "(" in name else name
    return shorten(text.replace("_", " "), 18)


def beside(model: UncertainModel, models: ModelSet) -> UnitResiduals:
    """Return the residuals of all units beside the weights of an uncertain model that was made of these models."""
    freqs = model.freqs_hz[:: max(1, len(model.freqs_hz) // _POINTS)]
    responses = (
        models.systems(model.unit_ids).frequency_response(freqs) * model.input_scale / model.output_scale[:, None]
    )
    own = model.scaled_nominal().frequency_response(freqs)
    dt, units, nominal = model.sample_period_s, model.unit_ids, model.nominal_id
    return unit_residuals(model.form, own, responses, model.weight, freqs, dt, unit_ids=units, nominal_id=nominal)


def entries_figure(found: Mapping[str, UnitResiduals], names: Mapping[str, Names], alarm: str | None = None) -> Figure:
    """Draw magnitudes of entries of all units with their bound and its fit, models side by side or one below the other."""
    sizes = {name: (min(r.largest.shape[1], _MOST), min(r.largest.shape[2], _MOST)) for name, r in found.items()}
    together = sum(columns for _, columns in sizes.values()) <= _MOST
    rows = (max if together else sum)(p for p, _ in sizes.values())
    columns = (sum if together else max)(m for _, m in sizes.values())
    figure, axes = grid(rows, columns, 1.45, sharex=True, sharey=True)
    top, left = 0, 0
    for name, residuals in found.items():
        p, m = sizes[name]
        _draw_block(axes[top : top + p, left : left + m], residuals, names[name], model_label(name), alarm)
        if together:
            left += m
            continue
        for panel in axes[top : top + p, m:].ravel():
            panel.axis("off")
        top += p
    for panel in axes[:, 0]:
        panel.set_ylabel(f"{panel.get_ylabel()}\n(dB)")
    axes[0, 0].set_ylim(*_limits([decibel(r.entries) for r in found.values()]))
    legend(figure, axes[0, 0])
    return figure


def _draw_block(block: Any, residuals: UnitResiduals, names: Names, label: str, alarm: str | None) -> None:
    inside, freqs = residuals.rows(inside=True), residuals.freqs_hz
    levels, bound, fitted = decibel(residuals.entries), decibel(residuals.largest), decibel(residuals.entry_weights)
    for i, row in enumerate(block):
        for j, panel in enumerate(row):
            lines_of_units(
                panel,
                freqs,
                levels[inside][..., i, j],
                Tone.BLUE.light,
                "units",
                [residuals.unit_ids[k] for k in inside],
            )
            panel.plot(freqs, bound[:, i, j], color=Tone.BLUE.light, lw=2.6, alpha=0.45, label="largest")
            panel.plot(freqs, fitted[:, i, j], color=Tone.INK.light, lw=1.1, label="fitted weight")
            _mark_unit(panel, residuals, levels[..., i, j], alarm)
            frequency_axis(panel, freqs, "", 6 if levels.shape[-1] < 2 else 4)
            order = f"order {residuals.entry_orders[i, j]}"
            note(panel, order, (1, 1), (-2, -2), ha="right", va="top", size=7, color=Tone.SOFT.light)
        row[0].set_ylabel(f"to {short(names[0][i])}")
    for j, panel in enumerate(block[0]):
        panel.set_title(f"{label},\nfrom {short(names[1][j])}")
    label_below(block[-1])


def _mark_unit(axes: Axes, residuals: UnitResiduals, levels: Array, alarm: str | None) -> None:
    if alarm in residuals.unit_ids:
        line = levels[residuals.unit_ids.index(str(alarm))]
        axes.plot(residuals.freqs_hz, line, color=Tone.ALARM.light, lw=1.5, label=f"unit {alarm}")


def _limits(levels: Sequence[Array]) -> tuple[float, float]:
    finite = np.concatenate([level[np.isfinite(level)] for level in levels])
    if not finite.size:
        return -_FLOOR_DB, 0.0
    high = float(finite.max())
    return max(float(np.percentile(finite, 1)), high - _FLOOR_DB) - 3.0, high + 14.0


def ratio_panel(axes: Axes, residuals: UnitResiduals, most: int = 4) -> None:
    """Draw the ratio of every unit to the weights, dB; the dashed line is what the weights allow."""
    inside, freqs = residuals.rows(inside=True), residuals.freqs_hz
    levels = decibel(residuals.ratio)
    lines_of_units(axes, freqs, levels[inside], Tone.BLUE.light, "units", [residuals.unit_ids[k] for k in inside])
    axes.plot(freqs, decibel(residuals.ratio[inside].max(axis=0)), color=Tone.BLUE.light, lw=1.3, label="largest")
    axes.axhline(0, color=Tone.INK.light, lw=0.9, ls="--")
    axes.set_ylim(_LOWEST_DB, float(np.nanmax(levels, initial=0.0)) + 4)
    frequency_axis(axes, freqs, "", most)
