"""Evaluation: errors and spectra of estimates and free runs against recordings.

Examples
--------
>>> import numpy as np
>>> from kros.evaluate import error_percent
>>> recorded = np.array([0.0, 2.0, -4.0]).reshape(3, 1, 1)  # sample, episode, channel
>>> error_percent(recorded + 0.1, recorded, np.array([3])).round(9).tolist()
[[2.5]]
"""

from .errors import error_percent, fit_percent
from .over_units import unit_interval

__all__ = ["error_percent", "fit_percent", "unit_interval"]
