"""The report of a run, its figures, and plots of results in memory. Nothing is computed here that is not shown.

    run folder + metrics ──► render ──► report.html
    run folder ──► write_figures ──► PNG and PDF
    a result in memory ──► plot ──► matplotlib Figure

matplotlib and Jinja2 are imported by nobody else, and only when something is drawn; pyplot is never touched.

Examples
--------
>>> from kros.core.lti import gain
>>> from kros.report import plot
>>> from kros.synthesis import Status, Synthesis
>>> plot(Synthesis("h2", gain([[0.5]], 0.01), Status.OPTIMAL, h2_norm=1.2)).axes[0].get_xscale()
'log'
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .files import write_figures
    from .html import render
    from .plotting import plot

_HOME = {"plot": "plotting", "render": "html", "write_figures": "files"}

__all__ = ["plot", "render", "write_figures"]


def __getattr__(name: str) -> Any:
    """Import the module behind a public name when it is first asked for."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names."""
    return sorted({*globals(), *__all__})
