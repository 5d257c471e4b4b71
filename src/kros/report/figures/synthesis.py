"""Figures of correction filters: beside plant and weights, and one filter with what is certified about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np

from ...core.lti import StateSpace
from ...design import Design
from ...identify import ModelSet
from ...identify.identified import IdentifiedModels
from ...observer import Observer
from ...synthesis.result import Injection, Synthesis
from ..canvas import Axes, Figure, decibel, frequency_axis, grid, legend, note
from ..names import (
    BASELINES,
    best_models,
    method_label,
    method_look,
    model_label,
    number,
    observer_label,
    split_observer,
)
from ..run_folder import NotShownError, RunFolder
from ..theme import DRAWING, HUES, Tone
from .entries import short
from .episodes import estimate_figure

_WITHOUT = (*BASELINES, "memory", "estimator")  # no correction of a model by design

Curve = tuple[str, np.ndarray, str, str]


def bode(run: RunFolder) -> tuple[Figure, str]:
    """Draw plant, weights and filters, linear beside Koopman (the paper's Figure 10)."""
    robust = {n: s for n, s in run.syntheses.items() if split_observer(n)[1] not in _WITHOUT}
    chosen = [m for m in best_models(run.models) if any(n.startswith(f"{m}/") for n in robust)]
    if not chosen:
        raise NotShownError("no robust observer has been synthesized")
    figure, axes = grid(1, len(chosen), 2.6, sharey=True)
    for panel, name in zip(axes[0], chosen, strict=True):
        syntheses = {n: s for n, s in robust.items() if n.startswith(f"{name}/")}
        _panel(panel, _curves(run, name, syntheses), run.models[name])
        panel.set_title(model_label(name))
    legend(figure, max(axes[0], key=lambda panel: len(panel.lines)), 4)
    axes[0, 0].set_ylabel("largest singular value (dB)")
    return figure, "Every signal over its largest value. K maps the innovation to the correction."


def _curves(run: RunFolder, name: str, syntheses: Mapping[str, Synthesis]) -> list[Curve]:
    """Return responses with their label, colour and style."""
    models = run.models[name]
    freqs = models.frequencies(DRAWING.frequencies, decades=DRAWING.decades)
    curves: list[Curve] = [("plant G", models.scaled_responses(freqs, [str(run.nominal)])[0], Tone.GREY.light, "-")]
    if name in run.uncertain:
        weight = run.uncertain[name].weight
        curves.append(("W left", weight.left.frequency_response(freqs), Tone.GOLD.light, "-"))
        curves.append(("W right", weight.right.frequency_response(freqs), Tone.GREEN.light, "--"))
    for observer, synthesis in syntheses.items():
        response, look = scaled_filter(synthesis, models).frequency_response(freqs), method_look(observer)
        curves.append((f"K {method_label(observer)}", response, look.colour, look.style))
    return curves


def _panel(axes: Axes, curves: Sequence[Curve], models: ModelSet) -> None:
    """Draw largest singular values, of filters that are zero none."""
    freqs = models.frequencies(DRAWING.frequencies, decades=DRAWING.decades)
    for label, response, colour, line in curves:
        size = decibel(np.linalg.norm(response, 2, axis=(-2, -1)))
        if np.isfinite(size).any():
            axes.plot(freqs, size, line, color=colour, lw=1.4, label=label)
    axes.axhline(0, color=Tone.SOFT.light, lw=0.7)
    frequency_axis(axes, freqs)


def scaled_filter(synthesis: Synthesis, models: ModelSet) -> StateSpace:
    """Return the correction filter with innovation and correction over the largest values of their signals."""
    K = synthesis.controller
    inside = models.output_scale[list(models.measured)]
    outside = models.input_scale if synthesis.injection is Injection.INPUT else models.output_scale
    return StateSpace(K.A, K.B * inside, K.C / outside[:, None], K.D * inside / outside[:, None], K.dt)


def synthesis_figure(result: Synthesis, labels: Sequence[str] = (), name: str = "") -> Figure:
    """Draw the entries of a correction filter, and its certificate as a list."""
    K = result.controller
    facts = {
        "status": result.status.value,
        "filter states": str(K.n_states),
        "H2 norm": number(result.h2_norm, 4),
        "H∞ norm": number(result.hinf_norm, 4),
        "worst-case H2": number(result.worst_case_h2, 4),
        "lower bound": number(result.lower_bound, 4),
        "gap (%)": number(result.gap_percent),
        "spectral radius": number(result.spectral_radius, 6),
    }
    figure, axes = _filter_figure(K, labels or [f"K{i + 1}{j + 1}" for i, j in np.ndindex(K.n_outputs, K.n_inputs)])
    axes[0, 0].set_title(name or method_label(result.method))
    axes[0, 2].axis("off")
    for row, (what, value) in enumerate(facts.items()):
        note(axes[0, 2], what, (0, 0.95 - 0.1 * row), va="top", size=8, color=Tone.SOFT.light)
        note(axes[0, 2], value, (0.5, 0.95 - 0.1 * row), va="top", size=8)
    return figure


def _entries(observer: Observer) -> list[str]:
    """Return from which innovation to which input or state each entry of the filter leads."""
    states, K = observer.lifting.states, observer.controller
    to = observer.inputs if observer.injection is Injection.INPUT else observer.lifting.names
    return [f"{short(states[j])} → {short(to[i])}" for i in range(K.n_outputs) for j in observer.measured]


def design_figure(design: Design, models: IdentifiedModels | None = None) -> Figure:
    """Draw the correction filter and its certificate, or with `models` the estimates on a held-out episode."""
    if models is not None:
        return estimate_figure(design.observer, models)
    return synthesis_figure(design.synthesis, _entries(design.observer), observer_label(design.observer.name))


def _filter_figure(K: StateSpace, labels: Sequence[str]) -> tuple[Figure, Any]:
    """Draw magnitude and phase of a filter's entries, with a third panel for notes."""
    figure, axes = grid(1, 3, 2.6)
    freqs = np.geomspace(1e-5, 1, DRAWING.frequencies) * (0.5 / K.dt if K.dt else 1e3)
    response = K.frequency_response(freqs).reshape(len(freqs), -1).T
    for i, (label, line, tone) in enumerate(zip(labels, response, cycle(HUES), strict=False)):
        axes[0, 0].plot(freqs, decibel(line), color=tone.light, label=label if i < len(HUES) else None)
        axes[0, 1].plot(freqs, np.degrees(np.unwrap(np.angle(line))), color=tone.light)
    if not response.any():
        note(axes[0, 0], "no correction", (0.5, 0.5), ha="center", color=Tone.SOFT.light)
    for panel, label in zip(axes[0, :2], ("magnitude (dB)", "phase (°)"), strict=True):
        frequency_axis(panel, freqs, most=4)
        panel.set_ylabel(label)
    legend(figure, axes[0, 0], columns=4)
    return figure, axes
