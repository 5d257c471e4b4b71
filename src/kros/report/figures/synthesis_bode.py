"""Magnitudes of the nominal plant, the weights and the correction filters, linear beside Koopman (the paper's Figure 10).

Needs: models, uncertain models, syntheses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...identify import ModelSet
from ...synthesis.result import Injection, Synthesis
from ..canvas import decibel, end_labels, frequency_axis, grid, limit_decibels
from ..names import BASELINES, best_models, method_label, model_label, observer_look, split_observer
from ..run_folder import NotShownError, RunFolder
from ..theme import Tone
from .drawing import Drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAME, TITLE = "synthesis", "Plant, weights and correction filters"
Array = npt.NDArray[Any]
NO_FILTER = ("memory",)  # measurements take the place of estimates: there is no correction of a model to draw
_POINTS = 260
_FLOOR_DB = 220.0  # filters for almost noiseless measurements and small weights are far apart


def draw(run: RunFolder) -> Drawing:
    """Draw one panel a model."""
    robust = {n: s for n, s in run.syntheses.items() if split_observer(n)[1] not in (*BASELINES, *NO_FILTER)}
    chosen = [m for m in best_models(run.models) if any(n.startswith(f"{m}/") for n in robust)]
    if not chosen:
        raise NotShownError("no robust observer has been synthesized")
    figure, axes = grid(1, len(chosen), 3.1, legend_rows=0, sharey=True)
    ends = []
    for panel, name in zip(axes[0], chosen, strict=True):
        ends.append(_panel(panel, run, name, {n: s for n, s in robust.items() if n.startswith(f"{name}/")}))
    limit_decibels(axes[0, 0], _FLOOR_DB)
    for panel, labels in zip(axes[0], ends, strict=True):
        end_labels(panel, labels, spacing=0.07)
    axes[0, 0].set_ylabel("largest singular value (dB)")
    return Drawing(
        figure,
        "Largest singular values over frequency, every signal over its largest value. Where the weights are low the nominal model can be "
        "trusted and needs little correction; where "
        "they are high the measurements have to speak, as far as their noise allows. K maps what was not predicted to the correction.",
    )


def _panel(axes: Axes, run: RunFolder, name: str, syntheses: dict[str, Synthesis]) -> list[tuple[float, str, str]]:
    models = run.models[name]
    freqs = models.frequencies(_POINTS, decades=5)
    plant = models.systems([str(run.choice["nominal"])])[0].frequency_response(freqs) * models.input_scale / models.output_scale[:, None]
    curves = [("plant G", plant, Tone.INK.light, "-")]
    weight = run.uncertain[name].weight if name in run.uncertain else None
    if weight is not None:
        curves += [
            ("W_L", weight.left.frequency_response(freqs), Tone.GOLD.light, "-"),
            ("W_R", weight.right.frequency_response(freqs), Tone.GREEN.light, "--"),
        ]
    for observer, synthesis in syntheses.items():
        response = scaled_filter(synthesis, models).frequency_response(freqs)
        curves.append((f"K {method_label(observer)}", response, observer_look(observer).colour, observer_look(observer).style))
    ends = []
    for label, response, colour, line in curves:
        size = decibel(np.linalg.norm(response, 2, axis=(-2, -1)))
        if np.isfinite(size).any():
            axes.plot(freqs, size, line, color=colour, lw=1.4)
            ends.append((float(size[-1]), label.replace("W_L", "W left").replace("W_R", "W right"), colour))
    axes.axhline(0, color=Tone.SOFT.light, lw=0.7)
    axes.set_title(model_label(name))
    frequency_axis(axes, freqs)
    return ends


def scaled_filter(synthesis: Synthesis, models: ModelSet) -> StateSpace:
    """Return the correction filter with innovation and correction over the largest values of their signals.

    Parameters
    ----------
    synthesis : Synthesis
    models : ModelSet
        Knows the ranges.
    """
    K = synthesis.controller
    inside = models.output_scale[list(models.measured)]
    outside = models.input_scale if synthesis.injection is Injection.INPUT else models.output_scale
    return StateSpace(K.A, K.B * inside, K.C / outside[:, None], K.D * inside / outside[:, None], K.dt)
