"""Uncertainty of a population: six forms, residuals, nominal, cover and weights, outliers. The stage's result is an `UncertainModel`."""

from .fit import FittedMagnitude, Side, fit_magnitude
from .forms import Form, existence, rebuild, residual
from .residuals import all_bounds, bounds, misfit, sigma_max

__all__ = [
    "FittedMagnitude",
    "Form",
    "Side",
    "all_bounds",
    "bounds",
    "existence",
    "fit_magnitude",
    "misfit",
    "rebuild",
    "residual",
    "sigma_max",
]
