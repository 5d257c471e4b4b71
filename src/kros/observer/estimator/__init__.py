"""The estimator: a linear regression of all states on a bank of fixed stable filters of what is measured, lifted and commanded.

measurements, lifting and inputs --channels--> signals --filters--> bank --ridge regression--> estimate --balanced truncation--> observer
"""

from .build import Identified

__all__ = ["Identified"]
