"""What limits the statements of a report: conditions that stand for units, and sets that are smaller than the models' own errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .names import condition_label, form_label, minus, model_label, number

SMALLER = 5.0  # times: a free run that is off by this much more than the set allows says that the set is not what limits the models


def conditions_apart(metrics: Mapping[str, Any]) -> bool:
    """Tell whether every unit was recorded in one of several conditions only, which confounds units and conditions."""
    recorded = [row["conditions"] for row in metrics.get("units", []) if row.get("conditions")]
    return len({c for conditions in recorded for c in conditions}) > 1 and all(
        len(conditions) == 1 for conditions in recorded
    )


def confounded_text(metrics: Mapping[str, Any]) -> list[str]:
    """Warn where units and conditions are confounded, or where some units took no part in the models; nothing where all is well."""
    units = [row for row in metrics.get("units", []) if row.get("conditions") and row.get("group") != "outliers"]
    home = metrics["study"]["identify_on"]
    known = [row["unit"] for row in units if home in row["conditions"]]
    if len(known) == len(units):
        return []
    about = f"Models, set, weights and observer are about the {len(known)} of {len(units)} units that were recorded in “{condition_label(home)}”"
    if not conditions_apart(metrics):
        return [f"{about}; about the others nothing was identified."]
    return [
        f"Units and conditions are confounded: each unit was recorded in one condition only, so a difference between units of two conditions may be "
        f"the machine's or the condition's. {about}; record the units in the same conditions to separate them."
    ]


def small_set_text(metrics: Mapping[str, Any], models: tuple[str, ...] | None = None) -> list[str]:
    """Warn of uncertain sets that are far smaller than the errors of their models in a free run; of all kinds of models, or of some."""
    texts = []
    for name, entry in metrics.get("uncertainty", {}).items():
        peak = entry.get("peak_db", {}).get(entry.get("form"))
        errors = metrics.get("models", {}).get(name, {}).get("freerun_error_percent", {})
        known = {channel: error["median"] for channel, error in errors.items() if error.get("median") is not None}
        if peak is None or not known or (models is not None and name not in models):
            continue
        channel = max(known, key=lambda c: known[c])
        size = 100 * 10 ** (peak / 20)
        if known[channel] > SMALLER * size:
            texts.append(
                f"The set of {model_label(name)} models is far smaller than their own errors: its residuals ({form_label(entry['form'])}) reach "
                f"{minus(f'{peak:.1f}')} dB, {number(size, 2)} %, and a free run misses {channel.replace('_', ' ')} by {number(known[channel], 2)} % of the "
                "largest value on the middle unit. The set holds how the models differ from one another, not how they differ from the machines; a "
                "guarantee over the set says nothing about that error."
            )
    return texts
