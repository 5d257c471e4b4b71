"""Free-running predictions of the linear and the Koopman model against the truth, with a zoom (the paper's Figure 5).

Needs: the evaluation's kept episodes with models.
"""

from __future__ import annotations

from ..canvas import grid, legend
from ..names import best_models, episode_title, is_koopman, model_label, model_look, number
from ..run_folder import NotShownError, RunFolder
from .drawing import Drawing
from .spectra import band_shares
from .trajectories import TRUTH, clip_to, draw_lines, hide_times, label_rows, shade, states, steady_window, zoom_s

NAME, TITLE = "free_run", "Predictions of the models"


def draw(run: RunFolder) -> Drawing:
    """Draw one held-out episode of the nominal unit."""
    shown = run.shown[0]
    chosen = best_models(shown.models)
    if not chosen:
        raise NotShownError("no model was run freely on the episode that is shown")
    channels = states(run)[:6]
    figure, axes = grid(len(channels), 2, 1.25, width_ratios=(1.5, 1))
    length_s = zoom_s(run, shown)
    window = steady_window(run, shown, length_s)
    for i, (full, zoom) in enumerate(axes):
        lines = [("recorded", shown.states[:, i], TRUTH)] + [(model_label(n), shown.models[n][:, i], model_look(n)) for n in chosen]
        draw_lines(full, shown.time_s, lines, width=0.9)
        draw_lines(zoom, shown.time_s, lines, window, width=1.3)
        clip_to(full, shown.states[:, i])
        clip_to(zoom, shown.states[window, i], 1.5)
        shade(full, shown.time_s, window)
    label_rows(axes[:, 0], channels)
    hide_times(axes[:-1].ravel())
    axes[0, 0].set_title(episode_title(shown.key))
    axes[0, 1].set_title(f"{length_s:g} s at constant speed" if run.calibrated else f"{length_s:g} s of it")
    for panel in axes[-1]:
        panel.set_xlabel("time (s)")
    legend(figure, axes[0, 0])
    return Drawing(figure, _caption(run, chosen))


def _caption(run: RunFolder, chosen: list[str]) -> str:
    text = "The whole held-out episode from the true first state and the recorded inputs alone, no measurement fed back. "
    lifted = [n for n in chosen if is_koopman(n)]
    if lifted and len(chosen) == 2 and _carries(run, chosen):
        text += "The linear model follows the average; the Koopman model carries the gearbox oscillation as well. "
    free = run.evaluation["free_run"]
    parts = [f"{model_label(n)} " + ", ".join(f"{c} {number(v['median'])} %" for c, v in free[n].items()) for n in chosen if n in free]
    return text + (f"Median error over units: {'; '.join(parts)}." if parts else "")


def _carries(run: RunFolder, chosen: list[str]) -> bool:
    """Whether the Koopman model leaves less than half of the linear one's power around the gearbox frequency in some state."""
    band_hz = run.evaluation.get("band_hz")
    if not band_hz:
        return False
    other, own = (run.arrays[f"spectrum/model/{n}"] for n in chosen)
    return min(band_shares(run.arrays["freqs_hz"], own, other, states(run), band_hz).values(), default=1.0) < 0.5
