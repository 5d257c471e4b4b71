"""Estimates of the load's torque beside the load that was declared, in time, and their errors over frequency."""

from __future__ import annotations

import numpy as np

from ....core.artifacts import read_arrays, read_json
from ....evaluate.errors import error_spectrum
from ...canvas import Figure, frequency_axis, grid, legend, logarithmic
from ...names import Look, in_condition, model_label
from ...run_folder import NotShownError, RunFolder
from ...theme import Tone
from ..episodes import TRUTH, clip_to, draw_lines, hide_times

_SEGMENT = 4096
_HIGHEST = 0.2  # of the sampling frequency
_LOWEST = 1e-8  # of the load's own density: below it nothing matters
_WAYS = (("load", "a load of its own"), ("current", "error of the\nrecorded current"))


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw estimates over the episode and power spectral densities of their errors, one row for each way to estimate."""
    if not run.has("load/load.json"):
        raise NotShownError("this study declares no load; set load.moment")
    content, arrays = read_json(run.folder / "load" / "load.json"), read_arrays(run.folder / "load" / "arrays.npz")
    ways = [(label, [n for n in content["estimates"] if n.endswith(f"/{way}")]) for way, label in _WAYS]
    ways = [(label, names) for label, names in ways if names]
    truth = arrays["truth"].astype(float)
    times = np.arange(len(truth)) * run.sample_period_s
    figure, axes = grid(len(ways), 2, 1.7, width_ratios=(1.6, 1), sharex="col")
    freqs, density = error_spectrum(truth, run.sample_period_s, _SEGMENT)
    for (label, names), (time, spectrum) in zip(ways, axes, strict=True):
        looks = {n: Look((Tone.BLUE if n.startswith("koopman") else Tone.ORANGE).light) for n in reversed(names)}
        estimates = {n: arrays[f"estimate/{n}"].astype(float) for n in looks}
        lines = [
            ("declared load", truth, TRUTH),
            *((model_label(n.partition("/")[0]), estimates[n], look) for n, look in looks.items()),
        ]
        draw_lines(time, times, lines, width=1.0)
        clip_to(time, truth, 0.35)
        time.set_ylabel(label)
        spectrum.plot(freqs[1:], density[1:], color=TRUTH.colour, alpha=TRUTH.opacity, lw=TRUTH.weight)
        for n, look in looks.items():
            spectrum.plot(
                freqs[1:], error_spectrum(estimates[n] - truth, run.sample_period_s, _SEGMENT)[1][1:], color=look.colour
            )
        logarithmic(spectrum)
        spectrum.set_ylim(bottom=_LOWEST * density.max())
        frequency_axis(spectrum, freqs[freqs <= _HIGHEST / run.sample_period_s], "")
    hide_times(axes[:-1].ravel())
    axes[0, 0].set_title("in units of current")
    axes[0, 1].set_title("PSD of load and errors, 1/Hz")
    axes[-1, 0].set_xlabel("time (s)")
    axes[-1, 1].set_xlabel("frequency (Hz)")
    legend(figure, axes[0, 0])
    unit, condition, _ = content["shown"]
    parts = [
        f"{r['observer']} {r['error_percent']:.0f} % of the load ({r['error_to_floor']:.2f} times its floor without load)"
        for r in content["rows"]
    ]
    text = f"Errors below 5 Hz over all units whose load was not known: {'; '.join(parts)}."
    return figure, f"Unit {unit}{in_condition(condition)}. {text}"
