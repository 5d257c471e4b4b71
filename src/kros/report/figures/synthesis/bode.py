"""Magnitudes of the nominal plant, the weights and the correction filters, linear beside Koopman (the paper's Figure 10)."""

from __future__ import annotations

import numpy as np

from ....core.lti import StateSpace
from ....identify import ModelSet
from ....synthesis.result import Injection, Synthesis
from ...canvas import Axes, Figure, decibel, end_labels, frequency_axis, grid, limit_decibels, zero_line
from ...names import BASELINES, best_models, method_label, model_label, observer_look, split_observer
from ...run_folder import NotShownError, RunFolder
from ...theme import Tone

_NO_FILTER = ("memory",)  # measurements take the place of estimates: there is no correction of a model to draw
_POINTS = 260
_FLOOR_DB = 220.0  # filters for almost noiseless measurements and small weights are far apart


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one panel a model."""
    robust = {n: s for n, s in run.syntheses.items() if split_observer(n)[1] not in (*BASELINES, *_NO_FILTER)}
    chosen = [m for m in best_models(run.models) if any(n.startswith(f"{m}/") for n in robust)]
    if not chosen:
        raise NotShownError("no robust observer has been synthesized")
    figure, axes = grid(1, len(chosen), 3.1, sharey=True)
    ends = [
        _panel(panel, run, m, {n: s for n, s in robust.items() if n.startswith(f"{m}/")})
        for panel, m in zip(axes[0], chosen, strict=True)
    ]
    limit_decibels(axes[0, 0], _FLOOR_DB)
    for panel, labels in zip(axes[0], ends, strict=True):
        end_labels(panel, labels, spacing=0.07)
    axes[0, 0].set_ylabel("largest singular value (dB)")
    return figure, (
        "Largest singular values over frequency, every signal over its largest value. Where the weights are low the nominal model can be trusted and needs "
        "little correction; where they are high the estimate has to follow the measurements, as far as their noise allows. K maps the innovation to the "
        "correction."
    )


def _panel(axes: Axes, run: RunFolder, name: str, syntheses: dict[str, Synthesis]) -> list[tuple[float, str, str]]:
    models = run.models[name]
    freqs = models.frequencies(_POINTS, decades=5)
    plant = models.scaled_responses(freqs, [str(run.choice["nominal"])])[0]
    curves = [("plant G", plant, Tone.INK.light, "-")]
    if name in run.uncertain:
        weight = run.uncertain[name].weight
        curves.append(("W left", weight.left.frequency_response(freqs), Tone.GOLD.light, "-"))
        curves.append(("W right", weight.right.frequency_response(freqs), Tone.GREEN.light, "--"))
    for observer, synthesis in syntheses.items():
        look = observer_look(observer)
        curves.append(
            (
                f"K {method_label(observer)}",
                scaled_filter(synthesis, models).frequency_response(freqs),
                look.colour,
                look.style,
            )
        )
    ends = []
    for label, response, colour, line in curves:
        size = decibel(np.linalg.norm(response, 2, axis=(-2, -1)))
        if np.isfinite(size).any():
            axes.plot(freqs, size, line, color=colour, lw=1.4)
            ends.append((float(size[-1]), label, colour))
    zero_line(axes)
    axes.set_title(model_label(name))
    frequency_axis(axes, freqs)
    return ends


def scaled_filter(synthesis: Synthesis, models: ModelSet) -> StateSpace:
    """Return the correction filter with innovation and correction over the largest values of their signals, which the models know."""
    K = synthesis.controller
    inside = models.output_scale[list(models.measured)]
    outside = models.input_scale if synthesis.injection is Injection.INPUT else models.output_scale
    return StateSpace(K.A, K.B * inside, K.C / outside[:, None], K.D * inside / outside[:, None], K.dt)
