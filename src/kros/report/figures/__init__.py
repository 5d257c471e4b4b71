"""Figures: one row of one table each, in the order of the paper's argument.

The function behind a row takes a `RunFolder` and the options of the row; it returns the figure and the rest of its caption.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

from ..run_folder import NotShownError, RunFolder
from ..theme import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Row:
    """A figure: its title, the module and function that draw it, the first sentence of its caption, and options."""

    title: str
    function: str
    see: str
    options: Mapping[str, Any] = field(default_factory=dict)


FIGURES: dict[str, Row] = {
    "signals": Row("Recorded signals", "recordings:signals", "One held-out episode as recorded."),
    "tracking_spectrum": Row(
        "Tracking error at constant speed",
        "recordings:tracking_spectrum",
        "The peaks at the dotted lines are the disturbance that the lifting models.",
    ),
    "phase": Row(
        "Phase calibration",
        "recordings:phase",
        "Phases may lie anywhere; lags should be nearly equal, and concentrations near one.",
    ),
    "models": Row(
        "Models of all units", "models:bode", "The spread of the lines is what the uncertain model has to bound."
    ),
    "free_run": Row(
        "Simulation of the models",
        "episodes:free_run",
        "The nearer a line is to the recorded one, the better the model predicts without measurements.",
    ),
    "forms": Row(
        "Six uncertainty forms", "uncertainty:forms", "The lowest line is the form in which units differ least."
    ),
    "weights": Row(
        "Weights and optimal bounds",
        "uncertainty:weights",
        "Lines should lie close to their shade: what is between them is uncertainty that no unit shows.",
    ),
    "weights_entrywise": Row(
        "Weights, entry by entry", "uncertainty:weights_entrywise", "Black lines lie above all blue ones."
    ),
    "synthesis": Row(
        "Plant, weights and correction filters",
        "synthesis:bode",
        "Where the weights are low the correction may be small; where they are high it has to follow the measurements.",
    ),
    "observers_in_time": Row("Estimates", "episodes:estimates", "The smaller the error, the better the estimate."),
    "observers_in_time_paper": Row(
        "Estimates of the paper's observers",
        "episodes:estimates",
        "The smaller the error, the better the estimate.",
        {"paper": True},
    ),
    "loaded_paper": Row(
        "Errors in another condition",
        "episodes:other_condition",
        "Under load the slow part of the current's error is the load torque.",
    ),
    "load_torque": Row(
        "Load torque", "disturbed:load_torque", "The nearer a line is to the declared load, the better the estimate."
    ),
    "robustness": Row(
        "Disturbed measurements",
        "disturbed:robustness",
        "Where a line rises, the disturbance is more than the observer takes.",
    ),
    "outlier_scores": Row(
        "Outlier scores",
        "outliers:scores",
        "The higher a unit scores, the more it differs from all others.",
    ),
    "outlier_residuals": Row(
        "The highest-scoring unit, entry by entry",
        "uncertainty:outlier_residuals",
        "Where the red line leaves the black one, the unit differs in that response.",
    ),
}


@dataclass(frozen=True, eq=False)
class Drawn:
    """A figure, or the reason why it is left out; `name` is also the name of its file."""

    name: str
    title: str
    figure: Figure | None = None
    caption: str = ""
    reason: str = ""


def draw(name: str, run: RunFolder) -> Drawn:
    """Draw one figure of a run; one that lacks an artifact comes with the reason instead."""
    row = FIGURES[name]
    module, _, function = row.function.partition(":")
    with style():
        try:
            figure, text = getattr(import_module(f".{module}", __name__), function)(run, **row.options)
            return Drawn(name, row.title, figure, f"{row.see} {text}".strip())
        except NotShownError as absent:
            return Drawn(name, row.title, reason=str(absent))


def draw_all(run: RunFolder) -> Iterator[Drawn]:
    """Draw all figures of a run, one at a time."""
    return (draw(name, run) for name in FIGURES)
