"""Bode magnitude of one correction filter with what is certified about it. For plots of results in memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ....core.lti import StateSpace
from ....synthesis.result import Synthesis
from ...canvas import Figure, decibel, frequency_axis, grid, legend, note
from ...names import method_label, number, observer_label
from ...theme import Tone

if TYPE_CHECKING:
    from ....observer import Observer


def synthesis_figure(result: Synthesis) -> Figure:
    """Draw the entries of the correction filter, and its certificate as a list."""
    facts = {
        "status": result.status.value,
        "filter states": str(result.controller.n_states),
        "H2 norm": number(result.h2_norm, 4),
        "H∞ norm": number(result.hinf_norm, 4),
        "worst-case H2": number(result.worst_case_h2, 4),
        "lower bound": number(result.lower_bound, 4),
        "gap (%)": number(result.gap_percent),
        "spectral radius": number(result.spectral_radius, 6),
    }
    return _filter_figure(result.controller, method_label(result.method), "certificate", facts)


def observer_figure(observer: Observer) -> Figure:
    """Draw the entries of an observer's correction filter, and what the observer is made of as a list."""
    facts = {
        "states": ", ".join(observer.lifting.states),
        "lifted functions": ", ".join(observer.lifting.functions) or "none",
        "measured": ", ".join(observer.lifting.states[i] for i in observer.measured),
        "inputs": ", ".join(observer.inputs),
        "correction of": observer.injection.value,
        "filter states": str(observer.controller.n_states),
        "sampling period": f"{number(observer.sample_period_s)} s",
    }
    return _filter_figure(observer.controller, observer_label(observer.name), "observer", facts)


def _filter_figure(K: StateSpace, name: str, title: str, facts: Mapping[str, str]) -> Figure:
    figure, axes = grid(1, 2, 2.6, width_ratios=(1.3, 1))
    panel, text = axes[0]
    freqs = np.geomspace(1e-5, 1, 300) * (0.5 / K.dt if K.dt else 1e3)
    response = K.frequency_response(freqs)
    for (i, j), tone in zip(np.ndindex(*response.shape[1:]), list(Tone) * response[0].size, strict=False):
        panel.plot(freqs, decibel(response[:, i, j]), color=tone.light, label=f"K{i + 1}{j + 1}")
    frequency_axis(panel, freqs)
    panel.set_ylabel("|K| (dB)")
    panel.set_title(f"correction filter, {name}")
    text.axis("off")
    text.set_title(title)
    for row, (what, value) in enumerate(facts.items()):
        note(text, what, (0, 0.95 - 0.12 * row), va="top", size=8, color=Tone.SOFT.light)
        note(text, value, (0.4, 0.95 - 0.12 * row), va="top", size=8)
    legend(figure, panel, columns=min(8, len(panel.lines)))
    return figure
