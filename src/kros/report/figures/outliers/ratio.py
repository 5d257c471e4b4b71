"""The highest-scoring unit against the cover of all the others, all directions at once (the paper's Figure 15 as a bound)."""

from __future__ import annotations

import numpy as np

from ....uncertainty.unit_residuals import UnitResiduals
from ...canvas import Figure, decibel, grid, legend
from ...names import form_label, in_condition, model_label, number
from ...run_folder import RunFolder
from ..residuals import ratio_panel


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one panel a kind of model."""
    condition, found = run.others
    first = next(iter(found.values()))
    unit = first.outside[0]
    figure, axes = grid(1, len(found), 2.2, sharey=True)
    for panel, (name, residuals) in zip(axes[0], found.items(), strict=True):
        ratio_panel(panel, residuals, unit, most=6)
        panel.set_title(model_label(name))
        panel.set_xlabel("frequency (Hz)")
    axes[0, 0].set_ylim(top=max(float(np.nanmax(decibel(r.ratio), initial=0.0)) for r in found.values()) + 4)
    axes[0, 0].set_ylabel("residual over\ncover (dB)")
    legend(figure, axes[0, 0])
    text = (
        f"Largest singular value of every unit's {form_label(first.form.value)} residual over the smallest diagonal cover of all units but "
        f"{unit}{in_condition(condition)}, nominal unit {first.nominal_id}. Dashed: what the others need. {excess_text(found, unit)}"
    )
    return figure, text


def excess_text(found: dict[str, UnitResiduals], unit: str) -> str:
    """Say where a unit leaves the cover of the others, and by how much."""
    parts = []
    for name, residuals in found.items():
        line = decibel(residuals.ratio[residuals.unit_ids.index(unit)])
        place = int(np.nanargmax(line))
        if line[place] > 0:
            where = f"at {number(residuals.freqs_hz[place])} Hz" if place else "towards zero frequency"
            parts.append(f"by {number(line[place])} dB {where} ({model_label(name)})")
    return f"Unit {unit} exceeds it {' and '.join(parts)}." if parts else f"Unit {unit} stays below it."
