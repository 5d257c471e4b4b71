"""Figures of a run: one row of one table each, in the order of the paper's argument; and of results in memory.

The function of a row takes a `RunFolder`; it returns the figure and more of its caption.
"""

from collections.abc import Callable
from importlib import import_module
from inspect import signature
from typing import Any

from ...core import ConfigError, frozen
from ..canvas import Figure
from ..run_folder import NotShownError, RunFolder
from ..theme import style


@frozen
class Row:
    """A figure: its title, the module and function that draw it, and the first sentence of its caption."""

    title: str
    function: str
    see: str


_SMALL = "The smaller the error, the better the estimate."
FIGURES: dict[str, Row] = {
    "signals": Row("Recorded signals", "recordings:signals", "One held-out episode as recorded."),
    "tracking_spectrum": Row("Tracking error", "recordings:tracking_spectrum", "Peaks are the modelled disturbance."),
    "phase": Row("Phase calibration", "recordings:phase", "Lags should be nearly equal, concentrations near one."),
    "models": Row(
        "Models of all units", "responses:models", "The uncertain model has to bound the spread of the lines."
    ),
    "free_run": Row("Simulation of the models", "episodes:free_run", "The smaller the error, the better the model."),
    "forms": Row("Six uncertainty forms", "uncertainty:forms", "Units differ least in the form with the lowest line."),
    "weights": Row("Weights and optimal bounds", "uncertainty:weights", "Lines should lie close to their shade."),
    "weights_entrywise": Row("Weights, entry by entry", "uncertainty:weights_entrywise", "Black bounds blue lines."),
    "synthesis": Row("Plant, weights and filters", "responses:filters", "High weights need a large correction."),
    "observers_in_time": Row("Estimates", "episodes:estimates", _SMALL),
    "observers_in_time_paper": Row("The paper's estimates", "episodes:paper_estimates", _SMALL),
    "loaded_paper": Row("Errors in another condition", "episodes:other_condition", _SMALL),
    "load_torque": Row("Load torque", "episodes:load_torque", "The nearer to the declared load, the better."),
    "outlier_scores": Row("Outlier scores", "outliers:scores", "The higher a unit, the more it differs."),
    "outlier_residuals": Row("Highest score", "uncertainty:outlier_residuals", "It differs where red leaves black."),
}


@frozen
class Drawn:
    """A figure, in the end as SVG, or the reason why it is left out; `name` is also the name of its file."""

    name: str
    title: str
    figure: Figure | None = None
    caption: str = ""
    reason: str = ""
    svg: str = ""


def drawing(place: str) -> Callable[..., Any]:
    """Return the function at a place, its module and its name."""
    module, _, function = place.partition(":")
    return getattr(import_module(f".{module}", __name__), function)


def draw(name: str, run: RunFolder) -> Drawn:
    """Draw one figure of a run; one that lacks an artifact comes with the reason instead."""
    row = FIGURES[name]
    with style():
        try:
            figure, text = drawing(row.function)(run)
            return Drawn(name, row.title, figure, f"{row.see} {text}".strip())
        except NotShownError as absent:
            return Drawn(name, row.title, reason=str(absent))


def run_figure(run: Any, name: str = "observers_in_time") -> Figure:
    """Draw one figure of the result of a run, by default the estimates of the deployed observer."""
    if name not in FIGURES:
        raise ConfigError(f"Plot of a run: there is no figure {name!r}; choose one of {', '.join(FIGURES)}.")
    drawn = draw(name, RunFolder(run.folder))
    if drawn.figure is None:
        raise ConfigError(f"Plot of a run: the figure {name!r} is left out, {drawn.reason}.")
    return drawn.figure


_ESTIMATES = {"estimates": "episodes:design_figure"}
PLOTS: dict[str, dict[str, str]] = {
    "Population": {"recorded": "recordings:population_figure"},
    "ModelSet": {"bode": "responses:bode_figure"},
    "IdentifiedModels": {"bode": "responses:identified_bode", "compare": "episodes:compare_figure"},
    "UncertainModel": {"weights": "uncertainty:uncertain_figure"},
    "UncertainModels": {"weights": "uncertainty:sets_figure"},
    "Design": _ESTIMATES,
    "Observer": _ESTIMATES,
    "RunResult": {"figure": ":run_figure"},
}
"""Class -> kind of figure -> module and function that draws it; its further parameters are the options of `plot`."""


def plot(result: Any, kind: str | None, **options: Any) -> Figure:
    """Draw a result."""
    name = type(result).__name__
    kinds = next((PLOTS[t.__name__] for t in type(result).__mro__ if t.__name__ in PLOTS), {})
    kind = kind or next(iter(kinds), "")
    if kind not in kinds:
        raise ConfigError(f"Plot: a {name} has no figure of kind {kind!r}; choose one of {', '.join(kinds)}.")
    function = drawing(kinds[kind])
    known = list(signature(function).parameters)[1:]
    if not set(options) <= set(known):
        raise ConfigError(f"Plot: no option {', '.join(options)}; {kind!r} has {', '.join(known) or 'none'}.")
    with style():
        return function(result, **options)
