"""Figures of results in memory, behind their method `plot`."""

from __future__ import annotations

from inspect import signature
from typing import Any

from ..core import ConfigError
from .canvas import Figure
from .figures import drawing
from .theme import style

_ESTIMATES = {"estimates": "episodes:design_figure"}
PLOTS: dict[str, dict[str, str]] = {
    "Population": {"recorded": "recordings:population_figure"},
    "ModelSet": {"bode": "models:bode_figure"},
    "IdentifiedModels": {
        "bode": "models:identified_bode",
        "compare": "episodes:compare_figure",
    },
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
    draw = drawing(kinds[kind])
    known = list(signature(draw).parameters)[1:]
    if not set(options) <= set(known):
        raise ConfigError(
            f"Plot: a {name} has no option {', '.join(options)}; {kind!r} has {', '.join(known) or 'none'}."
        )
    with style():
        figure: Figure = draw(result, **options)
    return figure
