"""Residuals of all units entry by entry, with their bound and its fit (the paper's Figure 8 as it is there)."""

from __future__ import annotations

from ....uncertainty.unit_residuals import UnitResiduals
from ...canvas import Figure
from ...names import best_models, form_label, model_label, number
from ...run_folder import RunFolder
from ..residuals import entries_figure, entry_names


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one panel an entry, linear beside Koopman."""
    found = {n: run.unit_residuals[n] for n in best_models(run.unit_residuals)}
    names = {n: entry_names(r.form, run.models[n]) for n, r in found.items()}
    first = next(iter(found.values()))
    text = (
        f"Magnitudes of the entries of all {form_label(first.form.value)} residuals against unit {first.nominal_id}, signals over their ranges, their largest "
        f"over the units, and a stable minimum-phase system above it. {excess_text(found)}"
    )
    return entries_figure(found, names), text


def excess_text(found: dict[str, UnitResiduals]) -> str:
    """Return what entrywise weights are worth with a full perturbation."""
    parts = [f"{number(r.entry_excess)} ({model_label(n)})" for n, r in found.items() if r.entry_excess > 1]
    if not parts:
        return "Bounds of entries do not bound a perturbation that is full; the design uses the weights above."
    return (
        f"Bounds of entries do not bound a full perturbation: σmax(W⁻¹E) reaches {' and '.join(parts)} where a bound would leave at most 1. "
        "The design uses the weights above."
    )
