"""Estimates of the deployed observer and its linear twin, or of the paper's pair, for the nominal and the worst off-nominal unit (the paper's Figure 11)."""

from __future__ import annotations

from collections.abc import Sequence

from ...canvas import Figure
from ...names import deployed_pair, observer_label, observer_look, shorten
from ...run_folder import NotShownError, RunFolder, Shown
from ..episodes import TRUTH, Line, Strip, overview_and_zoom, require_paper_pair

_MOST = 2  # states of one unit


def draw(run: RunFolder, paper: bool = False) -> tuple[Figure, str]:
    """Draw full episodes with a zoom at constant speed, nominal above worst off-nominal: every state that is not measured, and its errors below."""
    shown = kept_episodes(run)
    found = list(shown[0].observers)
    names, text = require_paper_pair(found) if paper else (deployed_pair(found, run.deployed), "")
    hidden = [i for i, channel in enumerate(run.states) if channel.name in run.hidden_states][:_MOST]
    blocks = []
    for role, episode in zip(("nominal", "worst off-nominal"), shown, strict=False):
        strips = []
        for i in hidden:
            recorded = episode.states[:, i]
            strips.append(Strip(run.states[i], [("recorded", recorded, TRUTH)], near=0.15))
            strips.append(Strip(run.states[i], error_lines(episode, names, i)))
        blocks.append((shorten(f"{role}: unit {episode.key.unit}, episode {episode.key.episode}", 46), episode, strips))
    text += f"Estimated from {' and '.join(c.name for c in run.states if c.measured)} alone; grey: as recorded; errors are recorded minus estimated. "
    text += "Errors of the start, before an observer has found the state, are cut off."
    return overview_and_zoom(run, blocks, 0.95), text


def error_lines(episode: Shown, names: Sequence[str], state: int) -> list[Line]:
    """Return recorded minus estimated values of a state, a line an observer."""
    return [
        (observer_label(n), episode.states[:, state] - episode.observers[n][:, state], observer_look(n)) for n in names
    ]


def kept_episodes(run: RunFolder) -> list[Shown]:
    """Return the kept episodes of the nominal and the worst off-nominal unit."""
    shown = [s for s in run.shown if s.key.condition == run.identify_on][:2]
    if not shown or not shown[0].observers:
        raise NotShownError("no observer was run on the episodes that are shown")
    return shown
