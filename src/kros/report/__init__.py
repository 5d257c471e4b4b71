"""The report of a run, its figures, and plots of results in memory. Nothing is computed here that is not displayed.

    metrics.json, run folder ──► render ──► report.html
    run folder ──► write_figures ──► PNG and PDF
    a result in memory ──► plot ──► matplotlib Figure

Only this package imports matplotlib and Jinja2, when something is drawn; pyplot is never touched.

Examples
--------
>>> import kros
>>> motors = kros.plants.DcMotorPopulation(n_units=1, n_episodes=1, seconds=1.0).simulate().population
>>> kros.report.plot(motors).axes[0].get_xscale()
'linear'
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.removed import lazy_names

if TYPE_CHECKING:
    from .plotting import plot

__all__ = ["plot"]
__getattr__, __dir__ = lazy_names(__name__, {"plot": "plotting"}, __all__)
