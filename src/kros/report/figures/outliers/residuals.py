"""Residual of the highest-scoring unit against those of all the others, entry by entry (the paper's Figure 15)."""

from __future__ import annotations

from ...canvas import Figure
from ...names import form_label, in_condition
from ...run_folder import RunFolder
from ..residuals import entries_figure, entry_names


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one panel an entry, linear beside Koopman."""
    condition, found = run.others
    first = next(iter(found.values()))
    unit = first.outside[0]
    names = {n: entry_names(r.form, run.condition_models(n, condition)) for n, r in found.items()}
    text = (
        f"Entries of the {form_label(first.form.value)} residuals against unit {first.nominal_id}{in_condition(condition)}, beside weights that are "
        f"fitted to all units but {unit}. It differs where it leaves them."
    )
    return entries_figure(found, names, alarm=unit), text
