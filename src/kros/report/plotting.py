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
    "UncertainModel": "uncertainty:uncertain_figure",
    "UncertainModels": "uncertainty:sets_figure",
    "Design": "episodes:design_figure",
    "RunResult": ":run_figure",
}
"""Name of a result's class -> module and function that draws it; further parameters are the options of `plot`."""


def plot(result: Any, **options: Any) -> Figure:
    """Return a figure of a result.

    Parameters
    ----------
    result : one of the classes in `PLOTS`
        A population: its first episode. Models: Bode plots. Uncertain models: weights, every unit relative to them.
        A design: the estimates on a held-out episode. A run: the estimates.
    **options
        ``kind`` of identified and uncertain models, such as ``"linear"``; ``models`` of a design, the identified models
        behind it; ``name`` of a run, any of its figures.

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
    >>> import kros
    >>> motors = kros.plants.DcMotorPopulation(n_units=1, n_episodes=1, seconds=1.0).simulate().population
    >>> len(kros.report.plot(motors).axes)  # position, velocity, current and voltage
    4
    """
    kinds = (t.__name__ for t in type(result).__mro__ if t.__module__.startswith("kros."))
    name = next((kind for kind in kinds if kind in PLOTS), None)
    if name is None:
        known_kinds = ", ".join(PLOTS)
        raise ConfigError(f"Plot: got a {type(result).__name__}; give one of {known_kinds}, or render a run folder.")
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
