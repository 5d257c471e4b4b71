"""Uncertainty of a population: six forms, nominal, weights that cover all units, outliers, variation and noise.

Examples
--------
>>> import numpy as np
>>> from kros.core import StateSpace
>>> from kros.uncertainty import quantify
>>> poles = np.array([0.88, 0.9, 0.91])[:, None, None]
>>> units = StateSpace(poles, 1 - poles, np.ones((3, 1, 1)), np.zeros((3, 1, 1)), 0.01)
>>> found = quantify(units, "additive")
>>> found.unit_ids[found.nominal], found.cover_max <= 1
('1', True)
"""

from ..core.linalg import sigma_max
from .bounded import choose_nominal
from .forms import Form, misfit, rebuild, residual
from .model import ResponseUncertainty, UncertainModel
from .outliers.model import OutlierModel, score_outliers
from .quantify import UncertainModels, quantify
from .weights.magnitude import fit_magnitude

__all__ = [
    "Form",
    "OutlierModel",
    "ResponseUncertainty",
    "UncertainModel",
    "UncertainModels",
    "choose_nominal",
    "fit_magnitude",
    "misfit",
    "quantify",
    "rebuild",
    "residual",
    "score_outliers",
    "sigma_max",
]
