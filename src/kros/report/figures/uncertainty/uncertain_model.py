"""One uncertain model: forms, weights over the cover, and every unit over the weights. For plots of results in memory."""

from __future__ import annotations

from ....core.errors import ConfigError
from ....identify import ModelSet
from ....uncertainty import UncertainModel
from ....uncertainty.quantify import UncertainModels
from ...canvas import Axes, Figure, decibel, end_labels, frequency_axis, grid, line_over_shade
from ...names import form_label
from ...theme import HUES
from ..residuals import beside, entries_figure, entry_names, ratio_panel
from .forms import FORM_TONES, draw_forms, window
from .weights import in_gauge


def uncertain_figure(model: UncertainModel, models: ModelSet | None = None, entries: bool = False) -> Figure:
    """Draw forms and weights of an uncertain model, and with the models that it was made of every unit over the weights."""
    if entries:
        if models is None:
            raise ConfigError(
                "Plot of an uncertain model: it holds no entries of units; pass models= the ModelSet that it was made of."
            )
        return entries_figure({models.name: beside(model, models)}, {models.name: entry_names(model.form, models)})
    figure, axes = grid(2 if models is None else 3, 1, 2.4, sharex=True)
    draw_forms(axes[0, 0], model)
    axes[0, 0].set_title(f"largest residual of {len(model.unit_ids)} units, nominal {model.nominal_id}")
    axes[0, 0].set_ylim(*window(model))
    end_labels(
        axes[0, 0], [(float(decibel(b)[-1]), form_label(f.value), FORM_TONES[f].light) for f, b in model.bounds.items()]
    )
    _weights(axes[1, 0], model)
    if models is not None:
        ratio_panel(axes[2, 0], beside(model, models), most=6)
        axes[2, 0].set_title("every unit over the weights")
    for panel in axes[:, 0]:
        panel.set_ylabel("(dB)")
        panel.set_xlabel("")
    frequency_axis(axes[-1, 0], model.freqs_hz)
    return figure


def sets_figure(found: UncertainModels, kind: str | None = None, entries: bool = False) -> Figure:
    """Draw the uncertain set of one kind of model, the first by default, with every unit over its weights, or entry by entry."""
    name = kind or next(iter(found.sets))
    if name not in found.sets:
        raise ConfigError(
            f"Plot of uncertain models: there is no set of kind {name!r}; choose one of {', '.join(found.sets)}."
        )
    return uncertain_figure(found.sets[name], found.models.models(name), entries)


def _weights(axes: Axes, model: UncertainModel) -> None:
    fitted, ends = model.weight.magnitudes(model.freqs_hz), []
    cover = in_gauge(model.cover, fitted)
    for side, lines, covers, style in (
        ("left", fitted.left, cover.left, "-"),
        ("right", fitted.right, cover.right, "--"),
    ):
        for i, tone in zip(range(lines.shape[1]), HUES, strict=False):
            line_over_shade(axes, model.freqs_hz, lines[:, i], covers[:, i], tone.light, style)
            ends.append((float(decibel(lines[:, i])[-1]), f"{side} {i + 1}", tone.light))
    axes.set_title("weights as used, over the optimal cover (shaded)")
    end_labels(axes, ends)
