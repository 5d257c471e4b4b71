"""How the units differ from the nominal one, and the weights that cover it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..content import Cell, Section, Table
from ..names import form_label, minus, model_label, number
from ..run_folder import RunFolder

_PAPER = (
    "Dashed lines in the figure are the paper's own residuals of the multiplicative forms. With more outputs than inputs its output forms hold the identity on "
    "the directions that the plant cannot reach, whatever the units do: at least 0 dB at every frequency. That is why the paper "
    "finds both output forms useless; "
    "the residuals used here are zero for equal plants and show what the units really do."
)

_HIGH = (
    "Peaks of 0 dB and more ({names}): units differ by more than all of the signal somewhere, and in an inverse form the set then "
    "contains ill-posed plants. Another form, "
    "better models, or fewer unlike units in one batch would bring it down."
)


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return forms, peaks and weights."""
    entries = metrics.get("uncertainty")
    if not entries:
        return None
    first = next(iter(entries.values()))
    text = (
        f"Nominal unit: {first['nominal']}. Every other unit is the nominal one perturbed by a residual; its largest singular value "
        "over frequency says how much. "
        f"The design uses the {form_label(first['form'])} form. Below 0 dB a unit differs by less than all of the signal."
    )
    tall = any(len(m.output_scale) > len(m.input_scale) for m in run.uncertain.values())
    high = [n for n, e in entries.items() if (e["peak_db"].get(e["form"]) or 0) >= 0]
    paragraphs = [text, *([_PAPER] if tall else []), *([_HIGH.format(names=", ".join(model_label(n) for n in high))] if high else [])]
    return Section("uncertainty", "Uncertainty", paragraphs, [_peaks(entries), _weights(entries)], ["forms", "weights"])


def _peaks(entries: Mapping[str, Any]) -> Table:
    forms = list(dict.fromkeys(f for e in entries.values() for f in e["peak_db"]))
    rows = []
    for form in forms:
        cells = [Cell(form_label(form))]
        for entry in entries.values():
            value, chosen = entry["peak_db"].get(form), entry["form"] == form
            cells.append(Cell("–" if value is None else minus(f"{value:.1f}"), strong=chosen, note="used" if chosen else ""))
        rows.append(cells)
    return Table(
        ["form", *(model_label(n) for n in entries)],
        rows,
        "Peak residual over units and frequencies, dB; the nominal unit that suits each form best.",
    )


def _weights(entries: Mapping[str, Any]) -> Table:
    rows = []
    for name, entry in entries.items():
        weight = entry["weight"]
        orders = " and ".join(", ".join(str(o) for o in side) for side in weight["orders"])
        cover = weight["cover_max"]
        rows.append(
            [
                Cell(model_label(name)),
                Cell(f"{weight['structure']}, orders {orders}"),
                Cell(number(cover, 6), note="holds" if cover is not None and cover <= 1 else "exceeded", strong=cover is None or cover > 1),
                Cell(number(weight["overbound_db_max"])),
                Cell(number(entry["misfit_max"])),
            ]
        )
    head = ["model", "weights, left and right", "largest normalised residual", "over the best cover (dB)", "largest misfit"]
    caption = (
        "A cover holds when no unit's normalised residual exceeds one. The misfit is what the form cannot rebuild, relative to the plant."
    )
    return Table(head, rows, caption)
