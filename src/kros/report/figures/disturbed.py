"""Errors against the severity of disturbances, and estimates of the load torque."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...core.artifacts import read_arrays, read_json
from ...evaluate.disturb import Kind
from ...evaluate.errors import error_spectrum
from ..canvas import Axes, Figure, frequency_axis, grid, legend, logarithmic, power_of_ten
from ..disturbances import AXES, Curve, curves
from ..names import in_condition, method_label, method_look, model_label, model_look, split_observer, words
from ..run_folder import NotShownError, RunFolder
from ..theme import DRAWING
from .episodes import TRUTH, draw_lines, hide_times

_WAYS = (("load", "load state"), ("current", "error of the\nrecorded current"))


def robustness(run: RunFolder) -> tuple[Figure, str]:
    """Draw one panel a disturbance, one line an observer, of the first hidden state."""
    rows, channel, condition = run.disturbed.get("robustness", []), run.states[run.hidden[0]].name, run.identify_on
    if not rows:
        raise NotShownError("the study did not run observers on disturbed measurements")
    tried, model = curves(rows, condition), split_observer(run.deployed or "")[0]
    names = [n for n in tried if n == run.deployed or split_observer(n)[0] in (model, "")]
    names = sorted((n for n in names if any(channel in c for c in tried[n].values())), key=lambda n: n == run.deployed)
    kinds = [kind for kind in AXES if any(kind in tried[n] for n in names)]
    figure, axes = grid(-(-len(kinds) // 4), min(4, len(kinds)), sharey=True)
    panels = axes.ravel()
    for panel, kind in zip(panels, kinds, strict=False):
        lines = {n: tried[n][kind][channel] for n in names if channel in tried[n].get(kind, {})}
        _panel(panel, kind, lines, run.deployed)
    for panel in panels[len(kinds) :]:
        panel.remove()
    for panel in axes[:, 0]:
        panel.set_ylabel("error (% of the\nlargest value)")
    logarithmic(panels[0], plain=True)
    legend(figure, panels[0], 4)
    seconds, units = run.disturbed["seconds"], len(run.disturbed["units"])
    return figure, (
        f"RMS error of the {words(channel)}{in_condition(condition)}, mean over {units} units, at most {seconds:g} s "
        "of a held-out episode. Lines end where the estimate diverges. Gaps take a tenth of the time. "
        "Filtered difference and learned estimator get the last measurement that arrived."
    )


def _panel(panel: Axes, kind: Kind, lines: Mapping[str, Curve], deployed: str | None) -> None:
    """Draw the curves of one disturbance; a logarithmic axis has a place for zero at its left end."""
    from matplotlib.ticker import NullLocator

    axis = AXES[kind]
    severities = next(iter(lines.values())).severities * axis.factor
    for name, curve in lines.items():
        x = curve.severities * axis.factor
        x = np.where(x > 0, x, 0.1 * x[1]) if axis.logarithmic else x
        look, main = method_look(name), name == deployed
        errors = np.where(curve.errors < DRAWING.diverged_percent, curve.errors, np.nan)
        label, width = method_label(name) + (" (deployed)" if main else ""), DRAWING.broad if main else None
        panel.plot(x, errors, look.style, color=look.colour, lw=width, marker="o", ms=2.4, label=label)
    panel.set_title(axis.title.replace(" (", "\n("), size="small")
    if axis.logarithmic:
        low, high = float(severities[1]), float(severities[-1])
        ticks = [10.0**k for k in range(int(np.ceil(np.log10(low))), int(np.floor(np.log10(high))) + 1)]
        ticks = ticks[:: 1 + len(ticks) // 4]
        panel.set_xscale("log")
        panel.set_xlim(0.07 * low, 1.4 * high)
        panel.xaxis.set_minor_locator(NullLocator())
        panel.set_xticks([0.1 * low, *ticks], ["0", *(power_of_ten(t) if "e" in f"{t:g}" else f"{t:g}" for t in ticks)])


def load_torque(run: RunFolder) -> tuple[Figure, str]:
    """Draw estimates of the load over an episode and spectra of their errors, a row a way to estimate."""
    if not run.has("load/load.json"):
        raise NotShownError("this study declares no load; set load.moment")
    content, arrays = read_json(run.folder / "load" / "load.json"), read_arrays(run.folder / "load" / "arrays.npz")
    ways = [(label, [n for n in content["estimates"] if n.endswith(f"/{way}")]) for way, label in _WAYS]
    ways = [(label, names) for label, names in ways if names]
    truth = arrays["truth"].astype(float)
    times = np.arange(len(truth)) * run.sample_period_s
    figure, axes = grid(len(ways), 2, width_ratios=(3, 2), sharex="col")
    freqs, density = error_spectrum(truth, run.sample_period_s, 4 * DRAWING.segment)
    for (label, names), (time, spectrum) in zip(ways, axes, strict=True):
        draw_lines(time, times, {"declared load": (truth, TRUTH)})
        spectrum.plot(freqs[1:], density[1:], color=TRUTH.colour, alpha=TRUTH.opacity, lw=TRUTH.weight)
        for name in reversed(names):
            model, values = name.partition("/")[0], arrays[f"estimate/{name}"].astype(float)
            look = model_look(model)
            draw_lines(time, times, {model_label(model): (values, look)})
            error = error_spectrum(values - truth, run.sample_period_s, 4 * DRAWING.segment)[1]
            spectrum.plot(freqs[1:], error[1:], color=look.colour)
        time.set_ylabel(label)
        logarithmic(spectrum)
        frequency_axis(spectrum, freqs, "")
    hide_times(axes[:-1].ravel())
    axes[0, 0].set_title("in units of current")
    axes[0, 1].set_title("PSD of load and errors, 1/Hz")
    axes[-1, 0].set_xlabel("time (s)")
    axes[-1, 1].set_xlabel("frequency (Hz)")
    legend(figure, axes[0, 0])
    unit, condition, _ = content["shown"]
    parts = [f"{r['observer']} {r['error_percent']:.0f} % of the load" for r in content["rows"]]
    text = f"Unit {unit}{in_condition(condition)}. Errors below 5 Hz over all units whose load was not known: "
    return figure, f"{text}{'; '.join(parts)}."
