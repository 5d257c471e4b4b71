"""Fitted weights over the optimal cover, left and right, their product against 0 dB, every unit over them (the paper's Figure 8)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ....uncertainty import Cover, Form, UncertainModel, sigma_max
from ....uncertainty.weights.cover import Structure
from ...canvas import Array, Axes, Figure, decibel, frequency_axis, grid, label_below, line_over_shade, note
from ...names import best_models, model_label, number
from ...run_folder import NotShownError, RunFolder
from ...theme import HUES, Tone
from ..residuals import ratio_panel, short

_INPUT_SIDE = (Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE)


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one row a model."""
    chosen = {n: run.uncertain[n] for n in best_models(run.uncertain)}
    names = {n: _entry_names(model, run, n) for n, model in chosen.items()}
    parts = [f"{model_label(n)} at most {number(model.overbound_db_max)} dB above it" for n, model in chosen.items()]
    text = (
        "Each residual is W_left · Δ · W_right with ‖Δ‖ ≤ 1. Lines: weights as used. Shaded: the cover with the smallest mean that diagonal weights could "
        f"have, frequency by frequency ({'; '.join(parts)}, by the mean); one weight may lie below its shade where another lies above. Product of both: "
        "below 0 dB the uncertain set holds no ill-posed unit."
    )
    try:
        found = {n: run.unit_residuals[n] for n in chosen if n in run.unit_residuals}
    except NotShownError:
        found = {}
    text += " Last column: every unit over the weights; at most 0 dB, so all are covered." if found else ""
    square = all(m.weight.left.n_outputs == m.weight.right.n_outputs for m in chosen.values())
    titles = [
        "left weight",
        "right weight",
        *(["product"] if square else []),
        *(["units over weights"] if found else []),
    ]
    figure, axes = grid(len(chosen), len(titles), 2.0, sharex=True)
    for row, (name, model) in zip(axes, chosen.items(), strict=True):
        _draw_row(row, model, names[name], square)
        if name in found:
            ratio_panel(row[-1], found[name])
        row[0].set_ylabel(f"{model_label(name)}\nmagnitude (dB)")
    for panel, title in zip(axes[0], titles, strict=True):
        panel.set_title(title)
    label_below(axes[-1])
    return figure, text


def _entry_names(model: UncertainModel, run: RunFolder, name: str) -> Sequence[str] | None:
    models = run.models.get(name)
    return None if models is None or model.form not in _INPUT_SIDE else models.inputs


def _draw_row(row: Sequence[Axes], model: UncertainModel, names: Sequence[str] | None, square: bool) -> None:
    fitted = model.weight.magnitudes(model.freqs_hz)
    cover = model.cover
    if model.weight.structure is Structure.ENTRYWISE:
        names = names and [f"{short(column)} → {short(row)}" for row in names for column in names]
    else:
        cover = in_gauge(cover, fitted)
    for panel, magnitudes, below in ((row[0], fitted.left, cover.left), (row[1], fitted.right, cover.right)):
        _draw_entries(panel, model.freqs_hz, magnitudes, below, names)
    if square:
        loop = model.weight.right.frequency_response(model.freqs_hz) @ model.weight.left.frequency_response(
            model.freqs_hz
        )
        _draw_product(row[2], model.freqs_hz, sigma_max(loop), (cover.left * cover.right).max(axis=1))


def in_gauge(cover: Cover, other: Cover) -> Cover:
    """Return a cover with the scale between left and right, which is free, of another: their right entries have the same mean in dB."""
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.exp((np.log(other.right) - np.log(cover.right)).mean(axis=1, keepdims=True))
    scale = np.where(np.isfinite(scale) & (scale > 0), scale, 1.0)
    return Cover(cover.left / scale, cover.right * scale)


def _draw_entries(axes: Axes, freqs_hz: Array, magnitudes: Array, cover: Array, names: Sequence[str] | None) -> None:
    if magnitudes.shape[1] > 1 and np.allclose(magnitudes, magnitudes[:, :1]):  # a scalar weight
        magnitudes, cover, names = magnitudes[:, :1], cover[:, :1], ["every signal"]
    labels = names if names and len(names) == magnitudes.shape[1] else [str(i + 1) for i in range(magnitudes.shape[1])]
    ends = []
    frequency_axis(axes, freqs_hz, "", 4)
    for i, tone in zip(range(magnitudes.shape[1]), HUES, strict=False):
        line_over_shade(axes, freqs_hz, magnitudes[:, i], cover[:, i], tone.light)
        ends.append((float(decibel(magnitudes[0, i])), labels[i].replace("_", " "), tone.light))
    if np.allclose(magnitudes, 1.0):
        axes.set_ylim(-20, 10)
    _start_labels(axes, ends)


def _start_labels(axes: Axes, ends: Sequence[tuple[float, str, str]]) -> None:
    """Label lines inside the axes, upper left, in the order of their levels at low frequency."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.13 * (high - low) * len(ends))
    for place, (_, text, colour) in enumerate(sorted(ends, reverse=True)):
        note(axes, text, (0, 1), (5, -9 * place - 1), va="top", color=colour)


def _draw_product(axes: Axes, freqs_hz: Array, product: Array, cover: Array) -> None:
    frequency_axis(axes, freqs_hz, "", 4)
    line_over_shade(axes, freqs_hz, product, cover, Tone.INK.light)
    axes.axhline(0, color=Tone.ALARM.light, lw=0.9, ls="--")
    note(axes, "0 dB", (0, 0), (4, -3), xycoords=("axes fraction", "data"), va="top", color=Tone.ALARM.light)
