"""What was recorded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...data.population import DEFAULT_CONDITION, OUTLIERS, Role
from ..content import Section, Table
from ..names import condition_label, number
from ..run_folder import NotShownError, RunFolder


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section:
    """Return units, conditions, episodes and channels."""
    study, facts = metrics["study"], run.facts
    filed = [u for u, group in facts["groups"].items() if group == OUTLIERS]
    episodes = {c: [sum(row[1] == c for row in facts[part]) for part in ("train", "test")] for c in study["conditions"]}
    names = {c: "" if c == DEFAULT_CONDITION else f"{condition_label(c)} " for c in episodes}
    counts = "; ".join(f"{names[c]}{train} for training, {test} held out" for c, (train, test) in episodes.items())
    text = f"{study['units']} units, sampled every {1e3 * study['sample_period_s']:g} ms. Episodes: {counts}. "
    if len(episodes) > 1:
        text += f"Models, uncertainty and observers come from “{condition_label(study['identify_on'])}” alone; the rest only tests them. "
    if filed:
        text += f"In the group of outliers, and kept out of everything pooled: {', '.join(filed)}. "
    for name, own in study.get("limits", {}).items():
        text += f"{_limited(name, own)} "
    if facts.get("dropped"):
        text += f"Left out for bad samples: {', '.join(facts['dropped'])}. "
    told = [
        f"{c.replace('_', ' ')}: {', '.join(f'{k} {v:g}' for k, v in own.items() if v)}"
        for c, own in study.get("sensor", {}).items()
    ]
    if told:
        text += f"Declared of the sensor beyond the recordings, and told to all: {'; '.join(told)}. "
    alerts = [f"Look at this first: {alert}" for alert in facts.get("alerts", ())]
    return Section("recordings", "Recordings", [*alerts, text], _channels(run), ["signals", "tracking_spectrum"])


def _limited(name: str, own: Mapping[str, Any]) -> str:
    """Say what limits a state."""
    ends = " and ".join(number(own[side]) for side in ("lower", "upper") if own[side] is not None)
    text = f"{name.replace('_', ' ').capitalize()} is limited at {ends}, {'as declared' if own['declared'] else 'found in the recordings'}"
    seen = own.get("seen")
    return (
        f"{text}; seen at a limit: {', '.join(seen['units'])}."
        if seen
        else f"{text}; no unit was seen there for certain."
    )


def _channels(run: RunFolder) -> list[Table]:
    try:
        channels = run.channels
    except NotShownError:
        return []
    steps, rows = run.facts["resolution"], []
    for c in channels:
        role = (
            "input"
            if c.role is Role.INPUT
            else "state, measured at run time"
            if c.measured
            else "state, to be estimated"
        )
        rows.append(
            [c.name.replace("_", " "), {"1": "fraction"}.get(c.unit, c.unit or "–"), role, number(steps.get(c.name))]
        )
    return [Table(["channel", "unit", "role", "resolution found"], rows)]
