"""One uncertain model alone, as a bound or entry by entry. For plots of results in memory."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

from ...core.errors import ConfigError
from ...identify import ModelSet
from ...uncertainty import UncertainModel
from ...uncertainty.unit_residuals import UnitResiduals, unit_residuals
from ..canvas import decibel, end_labels, frequency_axis, grid, thin_log
from ..names import form_label
from ..theme import Tone
from .entries import entries_figure, entry_names, ratio_panel
from .forms import FORM_TONES, window
from .weights import in_gauge

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_POINTS = 250


class Version(str, Enum):
    """How residuals are read: all directions at once, which bounds a perturbation, or one entry at a time, as in the paper's figures."""

    SOUND = "sound"
    ENTRYWISE = "entrywise"


def uncertain_figure(model: UncertainModel, version: str = "sound", models: ModelSet | None = None) -> Figure:
    """Draw forms and weights of a model.

    Parameters
    ----------
    model : UncertainModel
    version : {"sound", "entrywise"}
        Sound: largest singular values, weights and cover, and where `models` are given every unit over the weights. Entrywise: magnitudes of all
        units' entries with the best fit above each.
    models : ModelSet, optional
        Models that the uncertain model was made of; entries need them.

    Returns
    -------
    Figure

    Raises
    ------
    ConfigError
        For another version, or entries without models.
    """
    if version not in [v.value for v in Version]:
        raise ConfigError(f"Plot of an uncertain model: version {version!r} is unknown; choose 'sound' or 'entrywise'.")
    if version == Version.ENTRYWISE.value:
        if models is None:
            raise ConfigError(
                "Plot of an uncertain model: entries are those of the units, which it does not hold; pass models= the ModelSet behind it."
            )
        return entries_figure({models.name: beside(model, models)}, {models.name: entry_names(model.form, models)})
    if models is not None:
        return _with_units(model, models)
    figure, axes = grid(2, 1, 2.5, legend_rows=0, sharex=True)
    _forms(axes[0, 0], model)
    _weights(axes[1, 0], model)
    frequency_axis(axes[1, 0], model.freqs_hz)
    return figure


def beside(model: UncertainModel, models: ModelSet) -> UnitResiduals:
    """Return the residuals of all units beside the weights of an uncertain model."""
    freqs = model.freqs_hz[:: max(1, len(model.freqs_hz) // _POINTS)]
    responses = models.systems(model.unit_ids).frequency_response(freqs) * model.input_scale / model.output_scale[:, None]
    own = model.scaled_nominal().frequency_response(freqs)
    return unit_residuals(
        model.form,
        own,
        responses,
        model.weight,
        freqs,
        model.sample_period_s,
        unit_ids=model.unit_ids,
        nominal_id=model.nominal_id,
    )


def _with_units(model: UncertainModel, models: ModelSet) -> Figure:
    figure, axes = grid(3, 1, 2.2, legend_rows=0, sharex=True)
    _forms(axes[0, 0], model)
    _weights(axes[1, 0], model)
    ratio_panel(axes[2, 0], beside(model, models), most=6)
    axes[2, 0].set_title("every unit over the weights")
    axes[2, 0].set_ylabel("(dB)")
    frequency_axis(axes[2, 0], model.freqs_hz)
    return figure


def _forms(axes: Axes, model: UncertainModel) -> None:
    ends = []
    for form, bound in model.bounds.items():
        freqs, line = thin_log(model.freqs_hz, bound)
        axes.plot(freqs, decibel(line), color=FORM_TONES[form].light, lw=2.2 if form is model.form else 1.1)
        ends.append((float(decibel(bound)[-1]), form_label(form.value), FORM_TONES[form].light))
    axes.axhline(0, color=Tone.SOFT.light, lw=0.7)
    axes.set_title(f"largest residual of {len(model.unit_ids)} units, nominal {model.nominal_id}")
    axes.set_ylim(*window(model))
    axes.set_ylabel("(dB)")
    end_labels(axes, ends)


def _weights(axes: Axes, model: UncertainModel) -> None:
    fitted, ends = model.weight.magnitudes(model.freqs_hz), []
    cover = in_gauge(model.cover, fitted)
    for side, lines, covers, style in (("left", fitted.left, cover.left, "-"), ("right", fitted.right, cover.right, "--")):
        for i, tone in zip(range(lines.shape[1]), (Tone.BLUE, Tone.ORANGE, Tone.GREEN, Tone.PURPLE, Tone.GOLD, Tone.SKY), strict=False):
            freqs, line = thin_log(model.freqs_hz, lines[:, i])
            axes.plot(freqs, decibel(thin_log(model.freqs_hz, covers[:, i])[1]), color=tone.light, lw=3, alpha=0.3)
            axes.plot(freqs, decibel(line), style, color=tone.light)
            ends.append((float(decibel(lines[:, i])[-1]), f"{side} {i + 1}", tone.light))
    axes.set_title("weights as used, over the optimal cover (shaded)")
    axes.set_ylabel("(dB)")
    end_labels(axes, ends)
