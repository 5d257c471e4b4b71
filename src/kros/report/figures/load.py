"""Estimates of the load torque."""

from __future__ import annotations

import numpy as np

from ...core import load_artifact
from ...evaluate.errors import error_spectrum
from ..canvas import Captioned, frequency_axis, grid, legend, logarithmic, set_titles
from ..names import in_condition, model_label, model_look
from ..run_folder import NotShownError, RunFolder
from ..theme import DRAWING
from .episodes import TRUTH, draw_line

_WAYS = (("load", "load state"), ("current", "error of the\nrecorded current"))


def load_torque(run: RunFolder) -> Captioned:
    """Draw estimates of the load over an episode and spectra of their errors, a row a way to estimate."""
    if not run.has("load/load.json"):
        raise NotShownError("this study declares no load; set load.moment")
    content, arrays = load_artifact(run.folder / "load", "load")
    ways = [(label, [n for n in content["estimates"] if n.endswith(f"/{way}")]) for way, label in _WAYS]
    ways = [(label, names) for label, names in ways if names]
    truth = arrays["truth"].astype(float)
    times = np.arange(len(truth)) * run.sample_period_s
    figure, axes = grid(len(ways), 2, width_ratios=(3, 2), sharex="col")
    freqs, density = error_spectrum(truth, run.sample_period_s, 4 * DRAWING.segment)
    for (label, names), (time, spectrum) in zip(ways, axes, strict=True):
        draw_line(time, times, truth, TRUTH, "declared load")
        spectrum.plot(freqs[1:], density[1:], color=TRUTH.colour, alpha=TRUTH.opacity, lw=TRUTH.weight)
        for name in reversed(names):
            model, values = name.partition("/")[0], arrays[f"estimate/{name}"].astype(float)
            look = model_look(model)
            draw_line(time, times, values, look, model_label(model))
            error = error_spectrum(values - truth, run.sample_period_s, 4 * DRAWING.segment)[1]
            spectrum.plot(freqs[1:], error[1:], color=look.colour)
        time.set_ylabel(label)
        logarithmic(spectrum)
        frequency_axis(spectrum, freqs)
    set_titles(axes[0], ("in units of current", "PSD of load and errors, 1/Hz"))
    axes[-1, 0].set_xlabel("time (s)")
    legend(axes[0, 0])
    unit, condition, _ = content["shown"]
    parts = [f"{r['observer']} {r['error_percent']:.0f} % of the load" for r in content["rows"]]
    text = f"Unit {unit}{in_condition(condition)}. Errors below 5 Hz over all units whose load was not known: "
    return figure, f"{text}{'; '.join(parts)}."
