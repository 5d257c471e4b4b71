"""Population refinement: a pooled model on free-run error, then every unit with a prior centred on it.

Examples
--------
>>> from kros.identify.refine import RefineOptions
>>> RefineOptions().segments > 0
True
"""

from .population import refine_population
from .search import GaussNewton, RefineOptions

__all__ = ["GaussNewton", "RefineOptions", "refine_population"]
