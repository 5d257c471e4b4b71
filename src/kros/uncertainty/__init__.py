"""Uncertainty of a population: six forms, residuals, nominal, cover and weights, outliers. The stage's result is an `UncertainModel`."""

from .fits.magnitude import FittedMagnitude, Side, fit_magnitude, invert
from .fits.tightness import Tightness, magnitude_tightness, weight_tightness
from .forms import Form, existence, rebuild, residual, residual_shape
from .model import UncertainModel, scale_system
from .nominal.choice import Criterion, NominalChoice, choose_nominal, choose_nominals
from .outliers.model import OutlierModel, score_outliers
from .outliers.score import OutlierScore, Status
from .quantified import Quantified
from .residuals import all_bounds, bounds, completion, misfit, sigma_max
from .responses import ResponseUncertainty, quantify_responses
from .systems import quantify_systems
from .variation import VariationAndNoise, variation_and_noise
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
    "quantify_responses",
    "quantify_systems",
    "rebuild",
    "residual",
    "residual_shape",
    "scale_system",
    "score_outliers",
    "sigma_max",
    "variation_and_noise",
    "weight_tightness",
]
