"""Identified models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...core.linalg import radius_text
from ..content import Cell, Section, Table
from ..names import minus, model_label, number
from ..run_folder import RunFolder


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the models and how far they predict."""
    models = metrics.get("models")
    if not models:
        return None
    text = "Every unit gets its own model of each kind; the linear one has the original states only, the Koopman one lifted functions beside them. "
    alpha = metrics["study"].get("alpha")
    if alpha is not None:
        text += (
            f"Models named EDMD are the paper's recipe with one Tikhonov coefficient, {number(alpha)}, a multiple of the smallest that leaves "
            "every model stable unless the study sets one. "
        )
    if any(not name.endswith("_edmd") for name in models):
        text += (
            "The others are refined on their free-run error: first one model for the whole population, then every unit's own, held near the common one "
            "by a prior whose strength held-out training episodes choose. "
        )
    lifted = next((m.lifting.functions for m in run.models.values() if m.lifting.functions), ())
    if lifted:
        text += f"Lifted functions: {', '.join(lifted)}."
    units = metrics.get("units", [])
    unstable = [f"{row['unit']} ({row['status']})" for row in units if row["status"] not in ("ok", "not calibrated")]
    paragraphs = [text] + ([f"Units with a remark: {'; '.join(unstable)}."] if unstable else [])
    return Section("models", "Models", paragraphs, [_table(models)], ["models", "free_run", "free_run_spectra", "trade_off"])


def _table(models: Mapping[str, Any]) -> Table:
    channels = list(dict.fromkeys(c for entry in models.values() for c in entry.get("freerun_error_percent", {})))
    best = {(c, s): _least(models, c, s) for c in channels for s in ("median", "worst")}
    rows = []
    for name, entry in models.items():
        errors = entry.get("freerun_error_percent", {})
        cells = [Cell(model_label(name)), Cell(str(entry["order"])), Cell(minus(radius_text(entry["spectral_radius_max"])))]
        for c in channels:
            for statistic in ("median", "worst"):
                value = errors.get(c, {}).get(statistic)
                cells.append(Cell(number(value), strong=value is not None and value == best[c, statistic]))
        rows.append(cells)
    head = ["model", "states", "largest pole", *(["median", "worst"] * len(channels))]
    caption = "Free run of every held-out episode, error in percent of the largest value, over units. Best in bold."
    return Table(head, rows, caption if channels else "", [("", 3), *((c, 2) for c in channels)] if channels else ())


def _least(models: Mapping[str, Any], channel: str, statistic: str) -> float | None:
    values = [v for m in models.values() if (v := m.get("freerun_error_percent", {}).get(channel, {}).get(statistic)) is not None]
    return min(values, default=None)
