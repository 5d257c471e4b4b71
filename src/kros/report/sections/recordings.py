"""What was recorded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...data.population import DEFAULT_CONDITION, OUTLIERS
from ..content import Section, Table, text_cells
from ..names import condition_label, number
from ..run_folder import NotShownError, RunFolder


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section:
    """Return units, conditions, episodes and channels."""
    study, facts = metrics["study"], run.facts
    filed = [u for u, group in facts["groups"].items() if group == OUTLIERS]
    episodes = {c: [sum(row[1] == c for row in facts[part]) for part in ("train", "test")] for c in study["conditions"]}
    counts = "; ".join(f"{_where(c)}{train} for training, {test} held out" for c, (train, test) in episodes.items())
    text = f"{study['units']} units, sampled every {1e3 * study['sample_period_s']:g} ms. Episodes: {counts}. "
    if len(episodes) > 1:
        text += f"Models, uncertainty and observers come from “{condition_label(study['identify_on'])}” alone; the rest only tests them. "
    if filed:
        text += f"Filed as outliers and kept out of everything pooled: {', '.join(filed)}. "
    if facts.get("dropped"):
        text += f"Left out for bad samples: {', '.join(facts['dropped'])}."
    alerts = [f"Look at this first: {alert}" for alert in facts.get("alerts", ())]
    return Section("recordings", "Recordings", [*alerts, text], [t for t in [_channels(run)] if t], ["signals", "tracking_spectrum"])


def _where(condition: str) -> str:
    return "" if condition == DEFAULT_CONDITION else f"{condition_label(condition)} "


def _channels(run: RunFolder) -> Table | None:
    try:
        channels = run.channels
    except NotShownError:
        return None
    steps = run.facts["resolution"]
    rows = [
        text_cells(
            c.name.replace("_", " "),
            {"1": "fraction"}.get(c.unit, c.unit or "–"),
            "input" if c.role.value == "input" else ("state, measured at run time" if c.measured else "state, to be estimated"),
            number(steps.get(c.name)),
        )
        for c in channels
    ]
    return Table(["channel", "unit", "role", "resolution found"], rows)
