"""Uncertainty of a population: six forms, residuals, nominal, cover and weights, outliers. The stage's result is an `UncertainModel`.

Examples
--------
>>> import numpy as np
>>> from kros.core import StateSpace
>>> from kros.uncertainty import quantify_systems
>>> poles = np.array([0.88, 0.9, 0.91])[:, None, None]
>>> units = StateSpace(poles, 1 - poles, np.ones((3, 1, 1)), np.zeros((3, 1, 1)), 0.01)
>>> found = quantify_systems(units, "additive")
>>> found.unit_ids[found.nominal], found.cover_max <= 1
('1', True)
"""

from .fits.magnitude import FittedMagnitude, Side, Tightness, fit_magnitude, invert, magnitude_tightness
from .forms import Form, bounds, completion, existence, misfit, rebuild, residual, residual_shape
from .model import ResponseUncertainty, UncertainModel, scale_system
from .nominal.choice import Criterion, NominalChoice, choose_nominal, choose_nominals
from .outliers.model import OutlierModel, score_outliers
from .outliers.score import OutlierScore, Status
from .quantify import UncertainModels, quantify
from .responses import quantify_responses
from .small_matrices import sigma_max
from .systems import quantify_systems
from .variation import VariationAndNoise, variation_and_noise
from .weights.certificate import Method, certify
from .weights.cover import Cover, Perturbation, Structure, cover_ratio, optimal_cover
from .weights.fit import fit_weight
from .weights.pencils import ResidualSystems
from .weights.weight import EntrywiseWeight, Weight

__all__ = [
    "Cover",
    "Criterion",
    "EntrywiseWeight",
    "FittedMagnitude",
    "Form",
    "Method",
    "NominalChoice",
    "OutlierModel",
    "OutlierScore",
    "Perturbation",
    "ResidualSystems",
    "ResponseUncertainty",
    "Side",
    "Status",
    "Structure",
    "Tightness",
    "UncertainModel",
    "UncertainModels",
    "VariationAndNoise",
    "Weight",
    "bounds",
    "certify",
    "choose_nominal",
    "choose_nominals",
    "completion",
    "cover_ratio",
    "existence",
    "fit_magnitude",
    "fit_weight",
    "invert",
    "magnitude_tightness",
    "misfit",
    "optimal_cover",
    "quantify",
    "quantify_responses",
    "quantify_systems",
    "rebuild",
    "residual",
    "residual_shape",
    "scale_system",
    "score_outliers",
    "sigma_max",
    "variation_and_noise",
]
