"""Plots of results in memory: one verb, the figure that suits the result."""

from __future__ import annotations

from importlib import import_module
from inspect import signature
from typing import TYPE_CHECKING, Any

from ..core.errors import ConfigError
from .theme import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PLOTS = {
    "Population": "recordings:population_figure",
    "IdentifiedModels": "models:identified_figure",
    "UncertainModels": "uncertainty:sets_figure",
    "Design": "synthesis:design_figure",
    "RunResult": ":run_figure",
    "PhaseCalibration": "recordings:phase_figure",
    "ModelSet": "models:bode_figure",
    "UncertainModel": "uncertainty:uncertain_figure",
    "OutlierModel": "outliers:scores_figure",
    "Synthesis": "synthesis:synthesis_figure",
    "Observer": "synthesis:observer_figure",
}
"""Name of a result's class -> module and function that draws it; further parameters are the options of `plot`."""


def plot(result: Any, **options: Any) -> Figure:
    """Return a figure of a result.

    Parameters
    ----------
    result : one of the classes in `PLOTS`
        A population: its first episode. Models: Bode plots. Uncertain models: forms, weights, every unit relative to
        the weights. A design, a synthesis, an observer: the correction filter. A run: the estimates.
    **options
        ``kind`` of identified and uncertain models, such as ``"linear"``; ``entries=True`` for an uncertain model entry
        by entry; ``models`` of a design or an `UncertainModel`, the models behind it; ``name`` of a run, any of its
        figures; ``nominal`` of a `ModelSet`, a unit that stands out.

    Returns
    -------
    matplotlib.figure.Figure
        Not known to pyplot; notebooks show it, `figure.savefig(...)` writes it.

    Raises
    ------
    ConfigError
        For anything else, and for options that the result does not have.

    Examples
    --------
    >>> from kros.core.lti import gain
    >>> from kros.report import plot
    >>> from kros.synthesis import Status, Synthesis
    >>> figure = plot(Synthesis("h2", gain([[0.5]], 0.01), Status.OPTIMAL, h2_norm=1.2))
    >>> len(figure.axes)
    3
    """
    name = next(
        (t.__name__ for t in type(result).__mro__ if t.__name__ in PLOTS and t.__module__.startswith("kros.")), None
    )
    if name is None:
        raise ConfigError(
            f"Plot: got a {type(result).__name__}; give one of {', '.join(PLOTS)}, or render a run folder."
        )
    module, _, function = PLOTS[name].partition(":")
    draw = getattr(import_module(f"{__package__}.figures.{module}".rstrip(".")), function)
    known = list(signature(draw).parameters)[1:]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise ConfigError(
            f"Plot: a {name} has no option {', '.join(map(repr, unknown))}; it has {', '.join(known) or 'none'}."
        )
    with style():
        figure: Figure = draw(result, **options)
    return figure
