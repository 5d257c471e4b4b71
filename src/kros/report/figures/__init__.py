"""Figures, one file a figure, in the order of the paper's argument."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module

from ..run_folder import NotShownError, RunFolder
from ..theme import style
from .drawing import Drawing

FIGURES = (
    "signals",
    "tracking_spectrum",
    "phase",
    "bode",
    "free_run",
    "free_run_spectra",
    "trade_off",
    "forms",
    "variation",
    "weights",
    "weight_orders",
    "forms_entrywise",
    "weights_entrywise",
    "synthesis_bode",
    "certificates",
    "members",
    "errors_chart",
    "left_out",
    "observers_in_time",
    "observers_in_time_paper",
    "observer_spectra",
    "loaded",
    "loaded_paper",
    "loaded_spectra",
    "load_torque",
    "robustness",
    "robustness_second",
    "outlier_scores",
    "outlier_ratio",
    "outlier_residuals",
)

__all__ = ["FIGURES", "Drawing", "Result", "draw", "draw_all"]


@dataclass(frozen=True, eq=False)
class Result:
    """A figure that was drawn, or the reason why it was left out.

    Parameters
    ----------
    name : str
        Also the name of its file.
    title : str
    drawing : Drawing or None
    reason : str
        Why there is none; empty where there is one.
    """

    name: str
    title: str
    drawing: Drawing | None
    reason: str = ""


def draw(module_name: str, run: RunFolder) -> Result:
    """Draw one figure of a run; one that lacks an artifact comes with the reason instead."""
    module = import_module(f".{module_name}", __name__)
    with style():
        try:
            return Result(module.NAME, module.TITLE, module.draw(run))
        except NotShownError as absent:
            return Result(module.NAME, module.TITLE, None, str(absent))


def draw_all(run: RunFolder) -> Iterator[Result]:
    """Draw all figures of a run, one at a time."""
    return (draw(name, run) for name in FIGURES)
