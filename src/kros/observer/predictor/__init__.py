"""Subspace-identified predictors: observers whose hidden states are identified from the past of what they see.

`moments` collects what recordings say of hidden states and reduces it to a model of low order, `tuning` improves it on recordings, `build` writes it into
an observer, and `driven` runs the internal states along recordings.
"""

from .build import embedded, identify_predictor
from .driven import driven_coordinates, with_internal
from .moments import Past
from .tuning import tune_predictor

__all__ = ["Past", "driven_coordinates", "embedded", "identify_predictor", "tune_predictor", "with_internal"]
