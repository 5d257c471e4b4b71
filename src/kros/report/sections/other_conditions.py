"""Observers in conditions that no model has seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..content import Section
from ..names import condition_label
from ..run_folder import RunFolder


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the figures of errors in another condition; None where there is one condition."""
    study = metrics["study"]
    others = [c for c in study["conditions"] if c != study["identify_on"]]
    if not others or not metrics.get("evaluation"):
        return None
    names = ", ".join(condition_label(c) for c in others)
    text = f"Models, weights and observers know only “{condition_label(study['identify_on'])}”. Here they meet what they were not designed for: {names}."
    figures = ["loaded_paper", "loaded_spectra", *(["load_torque"] if metrics.get("load_torque") else [])]
    return Section("other-conditions", names[:1].upper() + names[1:], [text], [], figures)
