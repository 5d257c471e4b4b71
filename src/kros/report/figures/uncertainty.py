"""Figures of residuals and weights: six forms, weights over the optimal bound, entries of single units."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...core import AnyArray
from ...identify import ModelSet
from ...uncertainty import Form, UncertainModel, residual, sigma_max
from ...uncertainty.quantify import UncertainModels
from ...uncertainty.unit_residuals import UnitResiduals
from ...uncertainty.weights.cover import Cover
from ..canvas import (
    Axes,
    Captioned,
    Figure,
    decibel,
    frequency_axis,
    grid,
    label_below,
    legend,
    lines_of_units,
    note,
    set_titles,
)
from ..names import model_label, number, shorten, words
from ..run_folder import RunFolder
from ..theme import DRAWING, HUES, Tone

Names = tuple[Sequence[str], Sequence[str]]
FORM_TONES = {
    Form.ADDITIVE: Tone.INK,
    Form.INPUT_MULTIPLICATIVE: Tone.SKY,
    Form.OUTPUT_MULTIPLICATIVE: Tone.GOLD,
    Form.INVERSE_ADDITIVE: Tone.GREY,
    Form.INVERSE_INPUT_MULTIPLICATIVE: Tone.BLUE,
    Form.INVERSE_OUTPUT_MULTIPLICATIVE: Tone.ORANGE,
}
_PUBLISHED = (Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE)  # the input forms agree for tall plants


def forms(run: RunFolder) -> Captioned:
    """Draw the largest residuals in all forms, linear beside Koopman (the paper's Figure 7)."""
    chosen = run.uncertain
    used = words(next(iter(chosen.values())).form.value)
    text, dashed = "Largest residual over all units with the nominal unit that suits each form best.", ""
    figure, axes = grid(1, len(chosen), sharey=True)
    for panel, (name, model) in zip(axes[0], chosen.items(), strict=True):
        draw_forms(panel, model)
        if len(model.output_scale) > len(model.input_scale):  # the published forms of tall plants contain the identity
            dashed = " Dashed: the output forms as published, at least 0 dB whatever the units are."
            for form, (freqs, bound) in published_bounds(model, run.models[name]).items():
                panel.plot(freqs, decibel(bound), "--", color=FORM_TONES[form])
        panel.set_title(model_label(name))
    axes[0, 0].set_ylabel("largest residual (dB)")
    legend(axes[0, 0], 3)
    return figure, f"{text} Thick: in use, {used}.{dashed}"


def published_bounds(model: UncertainModel, models: ModelSet) -> dict[Form, tuple[AnyArray, AnyArray]]:
    """Return frequencies and bounds of the output forms as published."""
    freqs = model.freqs_hz[:: max(1, len(model.freqs_hz) // DRAWING.frequencies)]
    response = models.scaled_responses(freqs, model.unit_ids)
    bounds = {}
    for form in _PUBLISHED:
        row = model.unit_ids.index(model.nominals[form])
        size = sigma_max(residual(form, response[row], response, paper=True))
        bounds[form] = freqs, np.delete(size, row, axis=0).max(axis=0)
    return bounds


def draw_forms(axes: Axes, model: UncertainModel) -> None:
    """Draw the bounds of all forms over frequency, the form in use thick."""
    for form, bound in model.bounds.items():
        width = DRAWING.broad if form is model.form else None
        style = ":" if form is Form.INVERSE_OUTPUT_MULTIPLICATIVE else "-"  # it often hides output multiplicative
        axes.plot(model.freqs_hz, decibel(bound), style, color=FORM_TONES[form], lw=width, label=words(form.value))
    axes.axhline(0, color=Tone.SOFT, lw=DRAWING.thin)
    frequency_axis(axes, model.freqs_hz)


def weights(run: RunFolder) -> Captioned:
    """Draw fitted weights over the optimal bound, and every unit relative to them (the paper's Figure 8)."""
    chosen = run.unit_residuals
    figure, axes = grid(len(chosen), 3, sharex=True)
    for row, (name, residuals) in zip(axes, chosen.items(), strict=True):
        model = run.uncertain[name]
        _draw_weights(row, model, entry_names(model.form, run.models[name]))
        ratio_panel(row[2], residuals)
        row[0].set_ylabel(f"{model_label(name)}\nmagnitude (dB)")
    set_titles(axes[0], ("left weight", "right weight", "units relative to the weights"))
    text = "Shaded: the optimal bound by diagonal weights at each frequency; the scale between left and right is free. "
    parts = [f"{model_label(name)} {number(run.uncertain[name].overbound_db_max)} dB" for name in chosen]
    return figure, f"{text}Largest mean excess of a weight: {', '.join(parts)}. A unit at most 0 dB is bounded."


def uncertain_figure(model: UncertainModel) -> Figure:
    """Draw the weights of an uncertain model, and its largest residual in every form."""
    figure, axes = grid(1, 3, sharex=True)
    _draw_weights(axes[0], model)
    draw_forms(axes[0, 2], model)
    legend(axes[0, 2], 3)
    set_titles(axes[0], ("left weight (dB)", "right weight (dB)", "largest residual (dB)"))
    return figure


def _draw_weights(row: Sequence[Axes], model: UncertainModel, names: Names = ((), ())) -> None:
    """Draw left and right weights over the optimal bound, with the names of signals or their numbers."""
    fitted = model.weight.magnitudes(model.freqs_hz)
    cover = in_gauge(model.cover, fitted)
    _side(row[0], model.freqs_hz, fitted.left, cover.left, names[0])
    _side(row[1], model.freqs_hz, fitted.right, cover.right, names[1])


def in_gauge(cover: Cover, other: Cover) -> Cover:
    """Return a cover with the scale between left and right of another: equal means of right entries in dB."""
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.exp(np.log(other.right / cover.right).mean(axis=1, keepdims=True))
    scale = np.where(np.isfinite(scale) & (scale > 0), scale, 1.0)
    return Cover(cover.left / scale, cover.right * scale)


def _side(axes: Axes, freqs_hz: AnyArray, magnitudes: AnyArray, cover: AnyArray, names: Sequence[str]) -> None:
    """Draw the entries of one weight, each with its name."""
    columns = range(magnitudes.shape[1])
    labels = names or [str(i + 1) for i in columns]
    for i, tone in zip(columns, HUES, strict=False):
        shade, line = decibel(cover[:, i]), decibel(magnitudes[:, i])
        axes.plot(freqs_hz, shade, color=tone, lw=DRAWING.broad, alpha=DRAWING.shade, solid_capstyle="butt")
        axes.plot(freqs_hz, line, color=tone)
        note(axes, words(labels[i]), (0, 1), (4, -10 * i - 1), va="top", color=tone)
    frequency_axis(axes, freqs_hz)
    low, high = (-20.0, 10.0) if np.allclose(magnitudes, 1.0) else axes.get_ylim()
    axes.set_ylim(low, high + (high - low) * len(columns) / 4)


def ratio_panel(axes: Axes, residuals: UnitResiduals) -> None:
    """Draw every unit relative to the weights, dB, the largest one dark; the dashed line is what the weights allow."""
    rows, freqs = differing(residuals), residuals.freqs_hz
    levels = decibel(residuals.ratio)[rows]
    lines_of_units(axes, freqs, levels, Tone.BLUE, "units")
    first = int(np.where(np.isfinite(levels), levels, -np.inf).max(axis=1).argmax())
    axes.plot(freqs, levels[first], color=Tone.INK)
    note(axes, f"unit {residuals.unit_ids[rows[first]]}", (1, 0), (-3, 3), ha="right", color=Tone.INK)
    axes.axhline(0, color=Tone.ALARM, lw=DRAWING.thin, ls="--")
    frequency_axis(axes, freqs)


def weights_entrywise(run: RunFolder) -> Captioned:
    """Draw residuals entry by entry with their fitted weights (the paper's Figure 8 as published)."""
    chosen = run.unit_residuals
    first = next(iter(chosen.values()))
    text = f"Magnitudes of the entries of all {words(first.form.value)} residuals relative to unit {first.nominal_id}. "
    excess = [f"{number(r.entry_excess)} ({model_label(n)})" for n, r in chosen.items() if r.entry_excess > 1]
    text += "Bounds of entries do not bound a full perturbation"
    text += f": σmax(W⁻¹E) reaches {' and '.join(excess)}." if excess else "."
    return entries_figure(run, chosen), text


def outlier_residuals(run: RunFolder) -> Captioned:
    """Draw the residual of the highest-scoring unit beside those of the others (the paper's Figure 15)."""
    first = next(iter(run.others.values()))
    text = f"Entries of the {words(first.form.value)} residuals relative to unit {first.nominal_id}, weights fitted to "
    return entries_figure(run, run.others), text + f"all units but {first.outside[0]}."


def sets_figure(models: UncertainModels, model: str | None = None) -> Figure:
    """Draw one kind of model, the first by default."""
    return uncertain_figure(models.sets[models.models.models(model or next(iter(models.sets))).name])


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
