"""How the units differ from the nominal one, and the weights that cover it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..caveats import confounded_text, small_set_text
from ..content import Cell, Cells, Section, Table
from ..names import form_label, minus, model_label, number
from ..run_folder import RunFolder

_PAPER = (
    "Dashed lines in the figure are the paper's own residuals of the multiplicative forms. With more outputs than inputs its output forms hold the identity on "
    "the directions that the plant cannot reach, whatever the units do: at least 0 dB at every frequency. That is why the paper finds both output forms "
    "useless; the residuals used here are zero for equal plants and show what the units really do."
)

_HIGH = (
    "Peaks of 0 dB and more ({names}): units differ by more than all of the signal somewhere, and in an inverse form the set then contains ill-posed plants. "
    "Another form, better models, or a batch of more similar units would bring it down."
)


MANY = 0.5  # share of noise from which on longer recordings are advised


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return forms, peaks and weights."""
    entries = metrics.get("uncertainty")
    if not entries:
        return None
    first = next(iter(entries.values()))
    text = (
        f"Nominal unit: {first['nominal']}. Every other unit is the nominal one perturbed by a residual; its largest singular value over frequency says how "
        f"much. The design uses the {form_label(first['form'])} form. Below 0 dB a unit differs by less than all of the signal."
    )
    tall = any(len(m.output_scale) > len(m.input_scale) for m in run.uncertain.values())
    high = [n for n, e in entries.items() if (e["peak_db"].get(e["form"]) or 0) >= 0]
    paragraphs = [
        text,
        *([_PAPER] if tall else []),
        *([_HIGH.format(names=", ".join(model_label(n) for n in high))] if high else []),
    ]
    paragraphs += [*confounded_text(metrics), *small_set_text(metrics), *noise_text(entries)]
    tables = [_peaks(entries), _weights(entries)]
    return Section("uncertainty", "Uncertainty", paragraphs, tables, ["forms", "weights"])


def noise_text(entries: Mapping[str, Any]) -> list[str]:
    """Say whether longer recordings would make the uncertainty smaller, of the models that the observers use; nothing where it is unknown."""
    shares = {name: e["noise_share"]["at_peak"] for name, e in entries.items() if "noise_share" in e}
    if not shares:
        return []
    high = [model_label(n) for n, share in shares.items() if share >= MANY]
    low = [model_label(n) for n, share in shares.items() if share < MANY]
    text = (
        "Part of every residual is there because recordings are finite: a unit that is recorded again gets a slightly different model. Models of resampled "
        "episodes separate that part from what really differs between units. "
    )
    if low:
        text += f"Where the units differ most, they really differ ({', '.join(low)}): more recordings of the same units would not shrink the set. "
    if high:
        text += f"For {', '.join(high)} most of it is the recordings' length: record longer, or more episodes, before calling it a difference between machines."
    return [text.strip()]


def _peaks(entries: Mapping[str, Any]) -> Table:
    rows: list[Cells] = []
    for form in dict.fromkeys(f for e in entries.values() for f in e["peak_db"]):
        cells: list[Cell | str] = [form_label(form)]
        for entry in entries.values():
            value, chosen = entry["peak_db"].get(form), entry["form"] == form
            cells.append(
                Cell("–" if value is None else minus(f"{value:.1f}"), strong=chosen, note="used" if chosen else "")
            )
        rows.append(cells)
    caption = "Peak residual over units and frequencies, dB; the nominal unit that suits each form best."
    return Table(["form", *(model_label(n) for n in entries)], rows, caption)


def _weights(entries: Mapping[str, Any]) -> Table:
    rows: list[Cells] = []
    for name, entry in entries.items():
        weight, cover = entry["weight"], entry["weight"]["cover_max"]
        holds = cover is not None and cover <= 1
        rows.append(
            [
                model_label(name),
                f"{weight['structure']}, orders {' and '.join(', '.join(str(o) for o in side) for side in weight['orders'])}",
                Cell(number(cover, 6), note="holds" if holds else "exceeded", strong=not holds),
                number(weight["overbound_db_max"]),
                number(entry["misfit_max"]),
            ]
        )
    head = [
        "model",
        "weights, left and right",
        "largest normalised residual",
        "over the best cover (dB)",
        "largest misfit",
    ]
    caption = "A cover holds when no unit's normalised residual exceeds one. The misfit is what the form cannot rebuild, relative to the plant."
    return Table(head, rows, caption)
