"""The estimator: a linear regression of all states on a bank of fixed stable filters of what is measured, lifted and commanded.

measurements, lifting and inputs --channels--> signals --filters--> bank --ridge regression--> estimate --balanced truncation--> observer
"""

from .build import Identified, identify_estimator
from .regression import Recordings
from .settings import EstimatorSettings

__all__ = ["EstimatorSettings", "Identified", "Recordings", "identify_estimator"]
