"""A design: its correction with what is certified, or its estimates on a held-out episode. For plots of results in memory."""

from __future__ import annotations

import numpy as np

from ....data import EpisodeBatch
from ....design import Design
from ....evaluate.sensor import as_shown
from ....identify.identified import IdentifiedModels
from ....observer import Observer, run_observer
from ...canvas import Figure, grid, label_below, legend, note
from ...names import Look, episode_title, number, observer_label
from ...theme import Tone
from ..episodes import TRUTH, clip_to, draw_lines, hide_times, label_rows
from ..synthesis.correction import certificate_of, observer_figure


def design_figure(design: Design, models: IdentifiedModels | None = None) -> Figure:
    """Draw the correction filter and its certificates, or with `models` what the observer estimates."""
    if models is not None:
        return estimate_figure(design.observer, models)
    proof = design.certificate
    running = f"gain {number(proof.gain)}" if proof.certified else "not certified"
    error = design.facts.get("hidden_error_percent")
    facts = {
        **certificate_of(design.synthesis),
        "as it runs": running,
        "training error": "–" if error is None else f"{number(error)} %",
    }
    return observer_figure(design.observer, "certificate", facts)


def estimate_figure(observer: Observer, models: IdentifiedModels) -> Figure:
    """Draw recorded states and estimates on the first held-out episode of the units behind the models; what is measured is marked."""
    facts = models.facts
    key = next(k for k in facts.keys("test", condition=facts.identify_on) if k.unit in facts.pooled)
    batch = EpisodeBatch.read(models.population, [key], parameters=models.parameters)
    y = as_shown(batch, observer.sensor, models.population.states).measurements(observer.measured)
    estimate = run_observer(observer, y, batch.inputs, batch.parameters or None)[:, 0]
    channels = models.population.channels[: batch.states.shape[-1]]
    figure, axes = grid(len(channels), 1, 1.3, sharex=True)
    time_s = np.arange(len(estimate)) * batch.sample_period_s
    for i, (panel, channel) in enumerate(zip(axes[:, 0], channels, strict=True)):
        truth, look = batch.states[:, 0, i], Look(Tone.BLUE.light)
        draw_lines(panel, time_s, [("recorded", truth, TRUTH), (observer_label(observer.name), estimate[:, i], look)])
        clip_to(panel, truth, 0.15)
        note(
            panel,
            "measured" if channel.measured else "not measured",
            (1, 1),
            (-2, -2),
            ha="right",
            va="top",
            color=Tone.SOFT.light,
        )
    axes[0, 0].set_title(episode_title(key))
    label_rows(axes[:, 0], channels)
    hide_times(axes[:-1, 0])
    label_below(axes[-1], "time (s)")
    legend(figure, axes[0, 0])
    return figure
