"""Correction filters beside plant and weights."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...core import AnyArray, StateSpace, grouped
from ...design.task import split_name
from ...identify import ModelSet
from ...synthesis.result import Injection, Synthesis
from ..canvas import Captioned, decibel, frequency_axis, grid, legend
from ..names import label_of, method_look, model_label
from ..run_folder import NotShownError, RunFolder
from ..theme import DRAWING, Tone

Curve = tuple[str, AnyArray, str, str]


def bode(run: RunFolder) -> Captioned:
    """Draw largest singular values of plant, weights and filters, linear beside Koopman (the paper's Figure 10)."""
    robust = [n for n in run.syntheses if not label_of(n).baseline and split_name(n)[1] != "estimator"]
    if not robust:
        raise NotShownError("no robust observer has been synthesized")
    chosen = grouped(robust, lambda name: split_name(name)[0])
    figure, axes = grid(1, len(chosen), sharey=True)
    for panel, (name, observers) in zip(axes[0], chosen.items(), strict=True):
        freqs = run.models[name].frequencies(DRAWING.frequencies, decades=DRAWING.decades)
        for label, response, colour, line in _curves(run, name, observers, freqs):
            size = decibel(np.linalg.norm(response, 2, axis=(-2, -1)))
            if np.isfinite(size).any():  # not of a filter that is zero
                panel.plot(freqs, size, line, color=colour, label=label)
        panel.axhline(0, color=Tone.SOFT, lw=DRAWING.thin)
        frequency_axis(panel, freqs)
        panel.set_title(model_label(name))
    legend(max(axes[0], key=lambda panel: len(panel.lines)), 4)
    axes[0, 0].set_ylabel("largest singular value (dB)")
    return figure, "Every signal over its largest value. K maps the innovation to the correction."


def _curves(run: RunFolder, name: str, observers: Sequence[str], freqs: AnyArray) -> list[Curve]:
    """Return responses with their label, colour and style."""
    models = run.models[name]
    curves: list[Curve] = [("plant G", models.scaled_responses(freqs, [str(run.nominal)])[0], Tone.GREY, "-")]
    if name in run.uncertain:
        weight = run.uncertain[name].weight
        curves.append(("W left", weight.left.frequency_response(freqs), Tone.GOLD, "-"))
        curves.append(("W right", weight.right.frequency_response(freqs), Tone.GREEN, "--"))
    for observer in observers:
        K, look = scaled_filter(run.syntheses[observer], models), method_look(observer)
        curves.append((f"K {label_of(observer).text}", K.frequency_response(freqs), look.colour, look.style))
    return curves


def scaled_filter(synthesis: Synthesis, models: ModelSet) -> StateSpace:
    """Return the correction filter with innovation and correction over the largest values of their signals."""
    K = synthesis.controller
    inside = models.output_scale[list(models.measured)]
    outside = models.input_scale if synthesis.injection is Injection.INPUT else models.output_scale
    return StateSpace(K.A, K.B * inside, K.C / outside[:, None], K.D * inside / outside[:, None], K.dt)
