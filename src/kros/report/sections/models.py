"""Identified models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...core.linalg import radius_text
from ..content import Cell, Cells, Section, Table
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
    units = [
        f"{row['unit']} ({row['status']})"
        for row in metrics.get("units", [])
        if row["status"] not in ("ok", "not calibrated")
    ]
    paragraphs = [text] + ([f"Units with a remark: {'; '.join(units)}."] if units else [])
    return Section("models", "Models", paragraphs, [_table(models)], ["models", "free_run", "free_run_spectra"])


def _table(models: Mapping[str, Any]) -> Table:
    errors = {name: entry.get("freerun_error_percent", {}) for name, entry in models.items()}
    channels = list(dict.fromkeys(c for of_model in errors.values() for c in of_model))
    columns = [(c, statistic) for c in channels for statistic in ("median", "worst")]
    values = {
        name: [of_model.get(c, {}).get(statistic) for c, statistic in columns] for name, of_model in errors.items()
    }
    best = [min((v for v in column if v is not None), default=None) for column in zip(*values.values(), strict=True)]
    rows: list[Cells] = [
        [
            *(model_label(name), str(entry["order"]), minus(radius_text(entry["spectral_radius_max"]))),
            *(
                Cell(number(v), strong=v is not None and v == least)
                for v, least in zip(values[name], best, strict=True)
            ),
        ]
        for name, entry in models.items()
    ]
    head = ["model", "states", "largest pole", *(statistic for _, statistic in columns)]
    caption = "Free run of every held-out episode, error in percent of the largest value, over units. Best in bold."
    return Table(head, rows, caption if channels else "", [("", 3), *((c, 2) for c in channels)] if channels else ())
