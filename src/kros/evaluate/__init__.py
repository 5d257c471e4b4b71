"""Evaluation: errors and spectra of estimates and free runs against recordings."""

from .batch import EpisodeBatch
from .bootstrap import unit_interval
from .errors import ErrorSummary, error_percent, error_rms, error_spectrum, summarise

__all__ = ["EpisodeBatch", "ErrorSummary", "error_percent", "error_rms", "error_spectrum", "summarise", "unit_interval"]
