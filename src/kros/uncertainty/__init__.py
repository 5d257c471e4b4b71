"""Uncertainty of a population: six forms, residuals, nominal, cover and weights, outliers. The stage's result is an `UncertainModel`."""

from .fits.magnitude import FittedMagnitude, Side, fit_magnitude, invert
from .fits.tightness import Tightness, magnitude_tightness, weight_tightness
from .forms import Form, existence, rebuild, residual, residual_shape
from .model import UncertainModel, scale_system
from .outlying.outliers import OutlierModel, score_outliers
from .outlying.score import OutlierScore, Status
from .population.noise import VariationAndNoise, variation_and_noise
from .population.nominal import Criterion, NominalChoice, choose_nominal, choose_nominals
from .quantified import Quantified
from .quantify import quantify
from .residuals import all_bounds, bounds, completion, misfit, sigma_max
from .responses import ResponseUncertainty, quantify_responses
from .weights.certificate import Method, certify
from .weights.cover import Cover, Perturbation, Structure, cover_ratio, optimal_cover, optimal_left
from .weights.entrywise import EntrywiseWeight
from .weights.full import FullWeight
from .weights.pencils import ResidualSystems
from .weights.weight import Weight, fit_weight

__all__ = [
    "Cover",
    "Criterion",
    "EntrywiseWeight",
    "FittedMagnitude",
    "Form",
    "FullWeight",
    "Method",
    "NominalChoice",
    "OutlierModel",
    "OutlierScore",
    "Perturbation",
    "Quantified",
    "ResidualSystems",
    "ResponseUncertainty",
    "Side",
    "Status",
    "Structure",
    "Tightness",
    "UncertainModel",
    "VariationAndNoise",
    "Weight",
    "all_bounds",
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
    "optimal_left",
    "quantify",
    "quantify_responses",
    "rebuild",
    "residual",
    "residual_shape",
    "scale_system",
    "score_outliers",
    "sigma_max",
    "variation_and_noise",
    "weight_tightness",
]
