"""Free-running predictions of the linear and the Koopman model against the truth, with a zoom (the paper's Figure 5)."""

from __future__ import annotations

from ...canvas import Figure
from ...names import best_models, episode_title, is_koopman, model_label, model_look, number
from ...run_folder import NotShownError, RunFolder
from ..episodes import TRUTH, Strip, overview_and_zoom
from ..spectra import band_shares

_MOST = 6  # states that are shown


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one held-out episode of the nominal unit."""
    shown = run.shown[0]
    chosen = best_models(shown.models)
    if not chosen:
        raise NotShownError("no model was run freely on the episode that is shown")
    strips = []
    for i, channel in enumerate(run.states[:_MOST]):
        predicted = [(model_label(n), shown.models[n][:, i], model_look(n)) for n in chosen]
        strips.append(Strip(channel, [("recorded", shown.states[:, i], TRUTH), *predicted], near=0.35))
    return overview_and_zoom(run, [(episode_title(shown.key), shown, strips)], 1.25), _caption(run, chosen)


def _caption(run: RunFolder, chosen: list[str]) -> str:
    text = (
        "The whole held-out episode from the true first state and the recorded inputs alone, no measurement fed back. "
    )
    lifted = [n for n in chosen if is_koopman(n)]
    if lifted and len(chosen) == 2 and _reproduces(run, chosen):
        text += "The linear model follows the average; the Koopman model reproduces the gearbox oscillation as well. "
    free = run.evaluation["free_run"]
    parts = [
        f"{model_label(n)} " + ", ".join(f"{c} {number(v['median'])} %" for c, v in free[n].items())
        for n in chosen
        if n in free
    ]
    return text + (f"Median error over units: {'; '.join(parts)}." if parts else "")


def _reproduces(run: RunFolder, chosen: list[str]) -> bool:
    """Whether the Koopman model leaves less than half of the linear one's power around the gearbox frequency in some state."""
    if not run.band_hz:
        return False
    other, own = (run.arrays[f"spectrum/model/{n}"] for n in chosen)
    return min(band_shares(run.arrays["freqs_hz"], own, other, run.states, run.band_hz).values(), default=1.0) < 0.5
