"""Bode magnitude of one correction filter with what is certified about it. For plots of results in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np

from ....core.lti import StateSpace
from ....observer import Observer
from ....synthesis.result import Injection, Synthesis
from ...canvas import Figure, decibel, frequency_axis, grid, legend, note
from ...names import method_label, number, observer_label, shorten
from ...theme import HUES, Tone
from ..residuals import short

_LONGEST = 32  # characters of a fact


def synthesis_figure(result: Synthesis) -> Figure:
    """Draw the entries of the correction filter, and its certificate as a list."""
    K = result.controller
    labels = [f"K{i + 1}{j + 1}" for i, j in np.ndindex(K.n_outputs, K.n_inputs)]
    return _figure(K, labels, method_label(result.method), "certificate", certificate_of(result))


def certificate_of(result: Synthesis) -> dict[str, str]:
    """Return what is known about a correction filter, for people."""
    return {
        "status": result.status.value,
        "filter states": str(result.controller.n_states),
        "H2 norm": number(result.h2_norm, 4),
        "H∞ norm": number(result.hinf_norm, 4),
        "worst-case H2": number(result.worst_case_h2, 4),
        "lower bound": number(result.lower_bound, 4),
        "gap (%)": number(result.gap_percent),
        "spectral radius": number(result.spectral_radius, 6),
    }


def observer_figure(observer: Observer, title: str = "observer", facts: Mapping[str, str] | None = None) -> Figure:
    """Draw the entries of an observer's correction filter beside a titled list of facts, by default what the observer is made of."""
    states, K = observer.lifting.states, observer.controller
    facts = facts or {
        "states": ", ".join(states),
        "lifted functions": ", ".join(observer.lifting.functions) or "none",
        "measured": ", ".join(states[i] for i in observer.measured),
        "inputs": ", ".join(observer.inputs),
        "filter states": str(K.n_states),
        "sampling period": f"{number(observer.sample_period_s)} s",
    }
    to = observer.inputs if observer.injection is Injection.INPUT else observer.lifting.names
    labels = [f"{short(states[j])} → {short(to[i])}" for i in range(K.n_outputs) for j in observer.measured]
    return _figure(K, labels, observer_label(observer.name), title, facts)


def _figure(K: StateSpace, labels: Sequence[str], name: str, title: str, facts: Mapping[str, str]) -> Figure:
    figure, axes = grid(1, 2, 2.6, width_ratios=(1.3, 1))
    panel, text = axes[0]
    freqs = np.geomspace(1e-5, 1, 300) * (0.5 / K.dt if K.dt else 1e3)
    lines = decibel(K.frequency_response(freqs)).reshape(len(freqs), -1).T
    for i, (label, line, tone) in enumerate(zip(labels, lines, cycle(HUES), strict=False)):
        panel.plot(freqs, line, color=tone.light, label=label if i < len(HUES) else None)
    if not np.isfinite(lines).any():
        note(panel, "zero: the model alone is best", (0.5, 0.5), ha="center", color=Tone.SOFT.light)
    frequency_axis(panel, freqs)
    panel.set_ylabel("magnitude (dB)")
    panel.set_title(f"correction by {name}")
    text.axis("off")
    text.set_title(title)
    for row, (what, value) in enumerate(facts.items()):
        note(text, what, (0, 0.95 - 0.1 * row), va="top", size=8, color=Tone.SOFT.light)
        note(text, shorten(value, _LONGEST), (0.4, 0.95 - 0.1 * row), va="top", size=8)
    legend(figure, panel, columns=4)
    return figure
