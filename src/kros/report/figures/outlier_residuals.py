"""Residual of the most conspicuous unit against those of all the others, entry by entry (the paper's Figure 15).

Needs: outlier scores, models in the condition of the highest score.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...core.frequency import log_grid
from ...identify import ModelSet
from ...uncertainty import Form, residual
from ..canvas import decibel, frequency_axis, grid, legend
from ..names import condition_label, form_label
from ..run_folder import NotShownError, RunFolder
from ..theme import Tone
from .drawing import Drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAME, TITLE = "outlier_residuals", "Residuals of the most conspicuous unit"
Array = npt.NDArray[Any]
_POINTS, _NOMINALS, _MOST = 120, 24, 200
_INPUT_SIDE = (Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE)


def draw(run: RunFolder) -> Drawing:
    """Draw one panel an entry of the residual, in the condition where the unit scores highest."""
    rows = [r for r in run.outlier_rows if r["score"] is not None]
    if not rows:
        raise NotShownError("outlier scores need at least three units in a condition")
    top = max(rows, key=lambda r: (bool(r["outlier"]), float(r["score"])))
    scored = next((name for name in run.models if name.endswith("_edmd")), next(iter(run.models)))  # these exist in every condition
    models = run.condition_models(scored, top["condition"])
    form = next(iter(run.uncertain.values())).form
    flagged = {r["unit"] for r in rows if r["outlier"] and r["condition"] == top["condition"]}
    others = [u for u in models.unit_ids if u != top["unit"] and u not in flagged][:_MOST]
    freqs = log_grid(models.sample_period_s, _POINTS, decades=5)
    levels = typical_residuals(models, form, others, top["unit"], freqs)
    names = models.inputs if form in _INPUT_SIDE else tuple(str(i + 1) for i in range(max(levels.shape[-2:])))
    figure, axes = grid(levels.shape[-2], levels.shape[-1], 1.7, sharex=True, sharey=True)
    for i, row in enumerate(axes):
        for j, panel in enumerate(row):
            _panel(panel, freqs, levels[..., i, j], top)
            panel.set_title(f"{_short(names[j])} → {_short(names[i])}")
    for panel in axes[-1]:
        frequency_axis(panel, freqs)
    for panel in axes[:, 0]:
        panel.set_ylabel("residual (dB)")
    axes[0, 0].set_ylim(*_limits(levels))
    legend(figure, axes[0, 0])
    return Drawing(figure, _caption(top, form))


def typical_residuals(models: ModelSet, form: Form, others: list[str], unit: str, freqs: Array) -> Array:
    """Return entries of the residuals, dB: the median over the other units, each taken as nominal once.

    Parameters
    ----------
    models : ModelSet
    form : Form
    others : list of str
        Units that count as the batch.
    unit : str
        Unit that is looked at; comes last.
    freqs : ndarray, shape (frequency,), Hz

    Returns
    -------
    ndarray, shape (len(others) + 1, frequency, p', m')
    """
    response = models.systems([*others, unit]).frequency_response(freqs) * models.input_scale / models.output_scale[:, None]
    chosen = np.unique(np.linspace(0, len(others) - 1, min(_NOMINALS, len(others))).round().astype(int))
    levels = np.stack([decibel(residual(form, response[k], response)) for k in chosen])
    levels[np.arange(len(chosen)), chosen] = np.nan  # a unit against itself says nothing
    alone = len(chosen) == 1
    return np.nanmedian(levels[:, 1:] if alone else levels, axis=0)


def _panel(axes: Axes, freqs: Array, lines: Array, row: dict[str, Any]) -> None:
    from matplotlib.collections import LineCollection

    top = lines[:-1].max(axis=0)
    paths = [np.column_stack([freqs, line]) for line in lines[:-1] if np.isfinite(line).all()]
    axes.add_collection(LineCollection(paths, colors=Tone.BLUE.light, linewidths=0.6, alpha=0.3, label=f"{len(lines) - 1} others"))
    axes.plot(freqs, top, color=Tone.BLUE.light, lw=1.3, label="largest of the others")
    axes.plot(freqs, lines[-1], color=(Tone.ALARM if row["outlier"] else Tone.ORANGE).light, lw=1.6, label=f"unit {row['unit']}")


def _limits(lines: Array) -> tuple[float, float]:
    finite = lines[np.isfinite(lines)]
    high = float(finite.max())
    return max(float(np.percentile(finite, 1)), high - 80.0) - 3.0, high + 3.0


def _short(name: str) -> str:
    return name.replace("_", " ")


def _caption(top: dict[str, Any], form: Form) -> str:
    state = "flagged" if top["outlier"] else "not flagged, but the highest score"
    return (
        f"Entries of the {form_label(form.value)} residual, {condition_label(top['condition'])}; every other unit is the nominal "
        "one in turn, and the median is shown, so that "
        f"no single nominal decides. Unit {top['unit']} ({state}) beside all others: it is conspicuous where it leaves their envelope."
    )
