"""Evaluation: errors and spectra of estimates and free runs against recordings."""

from .errors import ErrorSummary, error_spectrum, summarise

__all__ = ["ErrorSummary", "error_spectrum", "summarise"]
