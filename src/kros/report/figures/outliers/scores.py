"""Outlier scores of all units against the threshold, with their range over all nominals, a row a condition."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ....data.population import natural_key
from ....uncertainty import OutlierModel, OutlierScore
from ...canvas import Axes, Figure, grid, name_units, note, units_axis
from ...names import condition_label, form_label, number
from ...run_folder import RunFolder
from ...theme import Tone


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw one point a unit with its range, flagged ones in the colour of alarm."""
    found = {c: run.outlier_models[c] for c in sorted(run.outlier_models, key=natural_key)}
    first = next(iter(found.values()))
    flagged = sorted({s.unit for m in found.values() for s in m.scores if s.outlier}, key=natural_key)
    rate, units = number(100 * first.false_alarm_rate, 2), len(first.unit_ids)
    caveat = (
        f"; {units} units alone cannot show so rare an event, so the rate rests on that model"
        if first.extrapolated
        else ""
    )
    text = (
        f"By how much the largest {form_label(first.form.value)} residual of every unit exceeds those of all the others: the median over all nominal units, "
        f"and as a bar the range with each of them as the only nominal. Dashed: threshold at a nominal false-alarm rate of {rate} % for "
        f"each good unit, from an exponential tail of the levels of the others{caveat}. "
    )
    return scores_figure(found), text + (f"Above it: {', '.join(flagged)}." if flagged else "No unit is above it.")


def scores_figure(found: Mapping[str, OutlierModel]) -> Figure:
    """Draw scores with their ranges, a row a condition."""
    units = sorted({s.unit for m in found.values() for s in m.scores}, key=natural_key)
    figure, axes = grid(len(found), 1, 1.6, sharex=True)
    for panel, (condition, model) in zip(axes[:, 0], found.items(), strict=True):
        _panel(panel, model, units)
        panel.set_title(condition_label(condition))
        panel.set_ylabel("score (dB)")
    units_axis(axes[-1, 0], units)
    return figure


def referred_range(score: OutlierScore) -> tuple[float, float]:
    """Return the range of a score over the nominals, referred to the threshold as the score itself is, dB."""
    shift = score.score_db - score.excess_db
    return score.lowest_db + shift, score.highest_db + shift


def _panel(axes: Axes, model: OutlierModel, units: list[str]) -> None:
    places = {u: i for i, u in enumerate(units)}
    for score in model.scores:
        tone, place = Tone.ALARM if score.outlier else Tone.BLUE, places[score.unit]
        low, high = referred_range(score)
        axes.plot([place, place], [low, high], color=tone.light, lw=3.5, alpha=0.3, solid_capstyle="butt")
        name_units(
            axes.plot(place, score.score_db, "o", ms=6 if score.outlier else 4, color=tone.light)[0], [score.unit]
        )
        if score.outlier:
            note(axes, score.unit, (place, score.score_db), (7, 4), xycoords="data", va="bottom", color=tone.light)
    if np.isfinite(model.threshold_db):
        axes.axhline(model.threshold_db, color=Tone.SOFT.light, lw=0.9, ls="--")
        text = f"threshold, {number(model.threshold_db)} dB"
        note(axes, text, (1, model.threshold_db), (-2, 3), xycoords=("axes fraction", "data"), ha="right")
    axes.margins(y=0.15)
