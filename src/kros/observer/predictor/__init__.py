"""Subspace-identified predictors: observers whose hidden states are identified from the past of what they see.

`moments` regresses the hidden states on the past in recordings and reduces this to a model of low order, `tuning` improves it on recordings,
`build` writes it into an observer, `limited` conditions it where hidden states meet limits, and `driven` runs the internal states along recordings.
"""

from .build import embedded, identify_predictor
from .choice import Recipe, choose
from .driven import driven_coordinates, with_internal
from .limited import conditioned, with_limits
from .moments import PastMoments
from .tuning import tune_predictor

__all__ = [
    "PastMoments",
    "Recipe",
    "choose",
    "conditioned",
    "driven_coordinates",
    "embedded",
    "identify_predictor",
    "tune_predictor",
    "with_internal",
    "with_limits",
]
