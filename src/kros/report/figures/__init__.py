"""Figures: one file a figure, one row of one table, in the order of the paper's argument.

The function `draw` of a figure's file takes a `RunFolder`, and the options of its row, and returns the figure
and what its caption says behind the sentence about what to see.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

from ..run_folder import NotShownError, RunFolder
from ..theme import style
from .see import SEE

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Row:
    """A figure of the report: its title, the module that draws it, and what that is told."""

    title: str
    module: str
    options: Mapping[str, Any] = field(default_factory=dict)


FIGURES: dict[str, Row] = {
    "signals": Row("Recorded signals", "recordings.signals"),
    "tracking_spectrum": Row("Tracking error at constant speed", "recordings.tracking_spectrum"),
    "phase": Row("Phase calibration", "recordings.phase"),
    "models": Row("Models of all units", "models.bode"),
    "free_run": Row("Predictions of the models", "models.free_run"),
    "free_run_spectra": Row("Spectra of the prediction errors", "models.free_run_spectra"),
    "forms": Row("Six uncertainty forms", "uncertainty.forms"),
    "weights": Row("Weights over the optimal cover", "uncertainty.weights"),
    "forms_entrywise": Row("Six uncertainty forms, entry by entry", "uncertainty.forms_entrywise"),
    "weights_entrywise": Row("Weights entry by entry", "uncertainty.weights_entrywise"),
    "synthesis": Row("Plant, weights and correction filters", "synthesis.bode"),
    "observers_in_time": Row("Estimates", "observers.in_time"),
    "observers_in_time_paper": Row("Estimates of the paper's observers", "observers.in_time", {"paper": True}),
    "observer_spectra": Row("Spectra of the estimation errors", "observers.spectra"),
    "loaded_paper": Row("Errors of the paper's observers in the other condition", "observers.other_condition"),
    "loaded_spectra": Row("Spectra of the errors in the other condition", "observers.other_condition_spectra"),
    "load_torque": Row("Load torque", "observers.load_torque"),
    "robustness": Row("Disturbed measurements", "observers.robustness"),
    "outlier_scores": Row("Outlier scores", "outliers.scores"),
    "outlier_residuals": Row("The highest-scoring unit, entry by entry", "outliers.residuals"),
}
LEFT_TO_FILES = ("forms_entrywise", "weights_entrywise", "outlier_residuals")
ON_THE_PAGE = tuple(name for name in FIGURES if name not in LEFT_TO_FILES)


@dataclass(frozen=True, eq=False)
class Drawn:
    """A figure that was drawn, or the reason why it was left out; `name` is also the name of its file."""

    name: str
    title: str
    figure: Figure | None = None
    caption: str = ""
    reason: str = ""


def draw(name: str, run: RunFolder) -> Drawn:
    """Draw one figure of a run; one that lacks an artifact comes with the reason instead."""
    row = FIGURES[name]
    with style():
        try:
            figure, text = import_module(f".{row.module}", __name__).draw(run, **row.options)
            return Drawn(name, row.title, figure, f"{SEE[name]} {text}")
        except NotShownError as absent:
            return Drawn(name, row.title, reason=str(absent))


def draw_all(run: RunFolder) -> Iterator[Drawn]:
    """Draw all figures of a run, one at a time."""
    return (draw(name, run) for name in FIGURES)
