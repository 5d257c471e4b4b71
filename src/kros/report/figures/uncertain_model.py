"""One uncertain model alone: bounds of its forms above, its weights below. For plots of results in memory."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...uncertainty import UncertainModel
from ..canvas import decibel, end_labels, frequency_axis, grid, thin_log
from ..names import form_label
from ..theme import Tone
from .forms import FORM_TONES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def uncertain_figure(model: UncertainModel) -> Figure:
    """Draw forms and weights of a model.

    Parameters
    ----------
    model : UncertainModel

    Returns
    -------
    Figure
    """
    figure, axes = grid(2, 1, 2.5, legend_rows=0, sharex=True)
    _forms(axes[0, 0], model)
    _weights(axes[1, 0], model)
    frequency_axis(axes[1, 0], model.freqs_hz)
    return figure


def _forms(axes: Axes, model: UncertainModel) -> None:
    ends = []
    for form, bound in model.bounds.items():
        freqs, line = thin_log(model.freqs_hz, bound)
        axes.plot(freqs, decibel(line), color=FORM_TONES[form].light, lw=2.2 if form is model.form else 1.1)
        ends.append((float(decibel(bound)[-1]), form_label(form.value), FORM_TONES[form].light))
    axes.axhline(0, color=Tone.SOFT.light, lw=0.7)
    axes.set_title(f"largest residual of {len(model.unit_ids)} units, nominal {model.nominal_id}")
    axes.set_ylabel("(dB)")
    end_labels(axes, ends)


def _weights(axes: Axes, model: UncertainModel) -> None:
    fitted, ends = model.weight.magnitudes(model.freqs_hz), []
    for side, lines, covers, style in (("left", fitted.left, model.cover.left, "-"), ("right", fitted.right, model.cover.right, "--")):
        for i, tone in zip(range(lines.shape[1]), (Tone.BLUE, Tone.ORANGE, Tone.GREEN, Tone.PURPLE, Tone.GOLD, Tone.SKY), strict=False):
            freqs, line = thin_log(model.freqs_hz, lines[:, i])
            axes.plot(freqs, decibel(thin_log(model.freqs_hz, covers[:, i])[1]), color=tone.light, lw=3, alpha=0.3)
            axes.plot(freqs, decibel(line), style, color=tone.light)
            ends.append((float(decibel(lines[:, i])[-1]), f"{side} {i + 1}", tone.light))
    axes.set_title("weights as used, over the optimal cover (shaded)")
    axes.set_ylabel("(dB)")
    end_labels(axes, ends)
