"""Evaluation: errors and spectra of estimates and free runs against recordings, also of disturbed ones.

Examples
--------
>>> import numpy as np
>>> from kros.evaluate import error_percent, error_rms
>>> recorded = np.array([0.0, 2.0, -4.0]).reshape(3, 1, 1)  # sample, episode, channel
>>> estimated, lengths = recorded + 0.1, np.array([3])
>>> [error(estimated, recorded, lengths).round(9).tolist() for error in (error_rms, error_percent)]
[[[0.1]], [[2.5]]]
"""

from ..core.removed import refusing
from .disturb import Kind
from .errors import error_percent, error_rms, error_spectrum
from .intervals import unit_interval
from .next_unit import next_unit_bound
from .truth import true_errors

__all__ = [
    "Kind",
    "error_percent",
    "error_rms",
    "error_spectrum",
    "next_unit_bound",
    "true_errors",
    "unit_interval",
]

__getattr__ = refusing(__name__)
