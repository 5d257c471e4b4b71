"""Outlier scores of all units beside the threshold, with their range over all nominal units, a row a condition."""

import numpy as np

from ...data import natural_key, some
from ...uncertainty import OutlierModel
from ..canvas import Axes, Captioned, dashed, grid, note, units_axis
from ..names import condition_label, number, words
from ..run_folder import RunFolder
from ..theme import DRAWING, Tone


def scores(run: RunFolder) -> Captioned:
    """Draw one point a unit with its range, flagged ones in the colour of alarm, a column a condition."""
    models = dict(sorted(run.outlier_models.items(), key=lambda item: natural_key(item[0])))
    first, scores = next(iter(models.values())), [score for model in models.values() for score in model.scores]
    flagged = sorted({score.unit for score in scores if score.outlier}, key=natural_key)
    about = (
        f"Excess of the largest {words(first.form.value)} residual of a unit over those of all others: median over all "
        "nominal units, and as a bar the range over them"
    )
    rate = number(100 * first.false_alarm_rate, 2)
    text = f"{about}. The threshold has a false-alarm rate of {rate} % for a good unit"
    text += "; with so few units the rate rests on an exponential tail. " if first.extrapolated else ". "
    text += f"Above it: {some(flagged)}." if flagged else "No unit is above it."
    if not any(np.isfinite(m.threshold_db) for m in models.values()):
        text = f"{about}. There is no threshold with fewer than eight units."
    units = sorted({score.unit for score in scores}, key=natural_key)
    figure, axes = grid(1, len(models), sharey=True)
    for panel, (condition, model) in zip(axes[0], models.items(), strict=True):
        _panel(panel, model, units)
        panel.set_title(condition_label(condition))
        units_axis(panel, units)
    axes[0, 0].set_ylabel("score (dB)")
    return figure, text


def _panel(axes: Axes, model: OutlierModel, units: list[str]) -> None:
    highest = max(model.scores, key=lambda s: s.score_db)
    for score in model.scores:
        tone, place = Tone.ALARM if score.outlier else Tone.BLUE, units.index(score.unit)
        shift = score.score_db - score.excess_db  # relative to the threshold, as the score itself
        ends = score.lowest_db + shift, score.highest_db + shift
        axes.plot([place] * 2, ends, color=tone, lw=DRAWING.broad, alpha=DRAWING.shade, solid_capstyle="butt")
        axes.plot(place, score.score_db, "o", ms=8 if score.outlier else 4, color=tone)
        if score.outlier or score is highest:
            note(axes, score.unit, (place, score.score_db), (8, 0), xycoords="data", va="center", color=tone)
    if np.isfinite(model.threshold_db):
        dashed(axes, model.threshold_db)
        text = f"threshold, {number(model.threshold_db)} dB"
        note(axes, text, (1, model.threshold_db), (-2, 3), xycoords=("axes fraction", "data"), ha="right")
