"""Error against severity: what observers do when measurements are worse than in the recordings."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ....evaluate import Kind
from ...canvas import Axes, Figure, grid, log_ticks, logarithmic
from ...disturbances import AXES, Curve, curves, look, shown_observers
from ...names import in_condition, method_label, model_label, split_observer
from ...run_folder import NotShownError, RunFolder
from ...theme import Tone

_COLUMNS, _AS_LARGE = 4, 100.0
_ZERO = 0.06  # place of "not disturbed" on a logarithmic axis, as a share of the smallest severity


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one panel a disturbance, one line an observer, of the first state that is not measured."""
    rows, hidden = run.disturbed.get("robustness", []), run.hidden_states
    if not rows:
        raise NotShownError("the study did not run observers on disturbed measurements")
    channel, condition = hidden[0], run.identify_on
    found = curves(rows, condition)
    names = [n for n in shown_observers(list(found), run.deployed) if any(channel in c for c in found[n].values())]
    kinds = [kind for kind in Kind if any(kind in found[n] for n in names)]
    figure, axes = grid(-(-(len(kinds) + 1) // _COLUMNS), _COLUMNS, 1.75, sharey=True)
    panels = axes.ravel()
    for panel, kind in zip(panels, kinds, strict=False):
        _panel(
            panel, kind, {n: found[n][kind][channel] for n in names if channel in found[n].get(kind, {})}, run.deployed
        )
    for panel in axes[:, 0]:
        panel.set_ylabel("error (% of the\nlargest value)")
    smallest = min(float(found[n][k][channel].errors[0]) for n in names for k in found[n] if channel in found[n][k])
    logarithmic(panels[0], plain=True)
    panels[0].set_ylim(max(smallest, 1e-6) / 1.6, 4 * _AS_LARGE)
    for panel in panels[len(kinds) :]:
        panel.axis("off")
    handles, labels = panels[0].get_legend_handles_labels()
    panels[-1].legend(handles, labels, loc="center left", bbox_to_anchor=(-0.1, 0.5), fontsize=7)
    return figure, _caption(run, channel, condition)


def _panel(panel: Axes, kind: Kind, lines: Mapping[str, Curve], deployed: str | None) -> None:
    from matplotlib.ticker import NullLocator

    axis = AXES[kind]
    for name, curve in lines.items():
        x = curve.severities * axis.factor
        if axis.logarithmic:
            x = np.where(x > 0, x, _ZERO * x[1])
        style, main = look(name), name == deployed
        panel.plot(
            x,
            np.minimum(curve.errors, 1e6),
            style.style,
            color=style.colour,
            lw=2.6 if main else 1.2,
            alpha=0.6 if main else 1.0,
            marker="o",
            ms=3.2 if main else 2.2,
            label=method_label(name) + (" (deployed)" if main else ""),
        )
    panel.axhline(_AS_LARGE, color=Tone.SOFT.light, lw=0.8, ls=":")
    panel.set_title(axis.title.replace(" (", "\n("), size=8)
    if axis.logarithmic:  # with a place for zero at its left end
        severities = next(iter(lines.values())).severities * axis.factor
        low, high = float(severities[1]), float(severities[-1])
        ticks = log_ticks(low * 0.99, high * 1.01, 3)
        panel.set_xscale("log")
        panel.set_xlim(0.7 * _ZERO * low, 1.4 * high)
        panel.xaxis.set_minor_locator(NullLocator())
        panel.set_xticks([_ZERO * low, *ticks], ["0", *(f"{t:g}" for t in ticks)])


def _caption(run: RunFolder, channel: str, condition: str) -> str:
    found, model = run.disturbed, split_observer(run.deployed or "")[0]
    where = f"mean over {len(found['units'])} units, the first {found['seconds']:g} s of a held-out episode"
    return (
        f"RMS error of the {channel.replace('_', ' ')}{in_condition(condition)}, {where}, with one disturbance at a time; at the left of every panel "
        f"there is none. Observers are those of the {model_label(model)} model. Gaps take a tenth of the time, whatever their length. The dotted line is an "
        "error as large as the signal; lines that leave the panel have diverged. Observers and the extended Kalman filter predict where a measurement is "
        "missing; the filtered difference and the learned estimator cannot, and get the last measurement that arrived."
    )
