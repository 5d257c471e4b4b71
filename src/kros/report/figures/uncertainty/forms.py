"""Bounds of the residuals of all six uncertainty forms, linear beside Koopman (the paper's Figure 7)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ....identify import ModelSet
from ....uncertainty import Form, UncertainModel, bounds
from ...canvas import Array, Axes, Figure, decibel, end_labels, frequency_axis, grid, note, thin_log, zero_line
from ...names import best_models, form_label, model_label, number
from ...run_folder import RunFolder
from ...theme import Tone

_PAPER_POINTS = 60
_FLOOR_DB = 80.0
FORM_TONES = {
    Form.ADDITIVE: Tone.INK,
    Form.INPUT_MULTIPLICATIVE: Tone.SKY,
    Form.OUTPUT_MULTIPLICATIVE: Tone.GOLD,
    Form.INVERSE_ADDITIVE: Tone.GREY,
    Form.INVERSE_INPUT_MULTIPLICATIVE: Tone.BLUE,
    Form.INVERSE_OUTPUT_MULTIPLICATIVE: Tone.ORANGE,
}
_PAPER_FORMS = (
    Form.OUTPUT_MULTIPLICATIVE,
    Form.INVERSE_OUTPUT_MULTIPLICATIVE,
)  # the input ones agree with ours for tall plants


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one panel a model."""
    chosen = {n: run.uncertain[n] for n in best_models(run.uncertain)}
    variants = {n: paper_bounds(m, run.models[n]) for n, m in chosen.items() if n in run.models and is_tall(m)}
    first = next(iter(chosen.values()))
    text = (
        "Largest singular value of the residuals over all units, for the nominal unit that suits each form best; signals over "
        "their ranges. Thick: the form in use, "
        f"{form_label(first.form.value)}."
    )
    text += _beyond(chosen)
    text += (
        " Dashed: the paper's variants of both output forms, 0 dB and more everywhere whatever the units do."
        if variants
        else ""
    )
    figure, axes = grid(1, len(chosen), 3.3, sharey=True)
    for panel, (name, model) in zip(axes[0], chosen.items(), strict=True):
        draw_forms(panel, model)
        _draw_variants(panel, variants.get(name, {}))
        panel.set_title(model_label(name))
    axes[0, 0].set_ylabel("largest residual (dB)")
    limits = [window(model) for model in chosen.values()]
    axes[0, 0].set_ylim(min(low for low, _ in limits), max(high for _, high in limits))
    last = list(chosen.values())[-1]
    ends = [
        (float(decibel(bound)[-1]), form_label(form.value), FORM_TONES[form].light)
        for form, bound in last.bounds.items()
    ]
    end_labels(axes[0, -1], ends, spacing=0.06)
    return figure, text


def _beyond(models: Mapping[str, UncertainModel]) -> str:
    """Name the forms whose peaks are above the figure."""
    high = max(window(model)[1] for model in models.values())
    parts = [
        f"{form_label(form.value)}, {model_label(name)}: {number(peak)} dB"
        for name, model in models.items()
        for form, peak in model.peak_db.items()
        if peak > high
    ]
    return f" Peaks above the figure: {'; '.join(parts)}." if parts else ""


def is_tall(model: UncertainModel) -> bool:
    """Tell whether there are more outputs than inputs, where the paper's output forms contain the identity."""
    return len(model.output_scale) > len(model.input_scale)


def paper_bounds(model: UncertainModel, models: ModelSet) -> dict[Form, tuple[Array, Array]]:
    """Return frequencies and bounds of the published pipeline's output forms, on a few frequencies."""
    every = max(1, len(model.freqs_hz) // _PAPER_POINTS)
    freqs = model.freqs_hz[::every]
    response = models.scaled_responses(freqs, model.unit_ids)
    found = {}
    for form in _PAPER_FORMS:
        nominal = model.nominals.get(form)
        row = model.unit_ids.index(nominal) if nominal in model.unit_ids else 0
        found[form] = (freqs, bounds(form, response, paper=True, nominals=[row])[0])
    return found


def window(model: UncertainModel) -> tuple[float, float]:
    """Return the levels between which the forms are compared, dB: the form in use is seen whole, others may leave the top."""
    used = decibel(model.bounds[model.form])
    levels = np.concatenate([decibel(b) for b in model.bounds.values()])
    levels = levels[np.isfinite(levels)]
    if not levels.size:
        return -_FLOOR_DB, 5.0
    high = min(float(levels.max()), max(float(np.nanmax(used, initial=-np.inf)) + 20.0, 15.0))
    low = min(float(np.percentile(levels, 1)), float(np.nanmin(used, initial=np.inf)))
    return max(low, high - _FLOOR_DB) - 3.0, max(high, 3.0) + 3.0


def draw_forms(axes: Axes, model: UncertainModel) -> None:
    """Draw the bounds of all forms over frequency, the form in use thick."""
    for form, bound in model.bounds.items():
        freqs, line = thin_log(model.freqs_hz, bound)
        used = form is model.form
        axes.plot(freqs, decibel(line), color=FORM_TONES[form].light, lw=2.4 if used else 1.2, zorder=3 if used else 2)
    zero_line(axes)
    frequency_axis(axes, model.freqs_hz)


def _draw_variants(axes: Axes, variants: Mapping[Form, tuple[Array, Array]]) -> None:
    for form, (freqs, bound) in variants.items():
        axes.plot(freqs, decibel(bound), "--", color=FORM_TONES[form].light, lw=1.0)
    level = max((float(decibel(bound)[0]) for _, bound in variants.values()), default=np.inf)
    if level < 3:
        note(axes, "output forms as in the paper", (0, level), (5, 3), xycoords=("axes fraction", "data"))
