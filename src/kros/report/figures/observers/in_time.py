"""Estimates of the deployed observer and its linear twin, or of the paper's pair, for the nominal and the worst off-nominal unit (the paper's Figure 11)."""

from __future__ import annotations

from ...canvas import Figure
from ...names import deployed_pair, is_koopman, observer_label, observer_look, shorten
from ...run_folder import NotShownError, RunFolder, Shown
from ..episodes import TRUTH, overview_and_zoom, require_paper_pair

_ROWS = 3  # states of one unit


def draw(run: RunFolder, paper: bool = False) -> tuple[Figure, str]:
    """Draw full episodes with a zoom at constant speed, nominal above worst off-nominal; the states that are not measured come first."""
    shown = kept_episodes(run)
    found = list(shown[0].observers)
    names, text = require_paper_pair(found) if paper else (deployed_pair(found, run.deployed), "")
    rows = sorted(sorted(range(len(run.states)), key=lambda i: run.states[i].measured)[:_ROWS])
    blocks = []
    for role, episode in zip(("nominal", "worst off-nominal"), shown, strict=False):
        lines = {
            i: [
                ("recorded", episode.states[:, i], TRUTH),
                *((observer_label(n), episode.observers[n][:, i], observer_look(n)) for n in names),
            ]
            for i in rows
        }
        blocks.append((shorten(f"{role}: unit {episode.key.unit}, episode {episode.key.episode}", 46), episode, lines))
    text += f"Estimates from {' and '.join(c.name for c in run.states if c.measured)} alone, as recorded. "
    if run.calibrated and any(is_koopman(n) for n in names):
        text += "On the right, how much of the gearbox oscillation each of them follows. "
    text += "The start shows how fast an observer finds the true state: all begin at the first measurement with everything else at zero."
    return overview_and_zoom(run, blocks, 1.15, near=0.15), text


def kept_episodes(run: RunFolder) -> list[Shown]:
    """Return the kept episodes of the nominal and the worst off-nominal unit."""
    shown = [s for s in run.shown if s.key.condition == run.identify_on][:2]
    if not shown or not shown[0].observers:
        raise NotShownError("no observer was run on the episodes that are shown")
    return shown
