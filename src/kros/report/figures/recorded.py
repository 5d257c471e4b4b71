"""Episodes for the figures of what was recorded: those that the evaluation kept, or the recordings themselves in a run that stopped before it."""

from __future__ import annotations

import numpy as np

from ...data.population import OUTLIERS, EpisodeKey
from ..run_folder import NotShownError, RunFolder, Shown


def recorded_episodes(run: RunFolder) -> list[Shown]:
    """Return one held-out episode of one unit in every condition, the condition that was identified on first."""
    try:
        unit = run.shown[0].key.unit
        found = [s for s in run.shown if s.key.unit == unit]
    except NotShownError:
        found = _from_recordings(run)
    return sorted(found, key=lambda s: s.key.condition != run.identify_on)


def _from_recordings(run: RunFolder) -> list[Shown]:
    groups = run.facts["groups"]
    unit = next((u for u, group in groups.items() if group != OUTLIERS), next(iter(groups)))
    keys = {key.condition: key for key in (EpisodeKey(*row) for row in reversed(run.facts["test"])) if key.unit == unit}
    return [_read(run, key) for key in keys.values()]


def _read(run: RunFolder, key: EpisodeKey) -> Shown:
    states, inputs = run.population.read_parts(key)
    return Shown(key, np.arange(len(states)) * run.sample_period_s, states, inputs, {}, {})
