"""Evaluation: errors and spectra of estimates and free runs against recordings, also of disturbed ones; Monte Carlo over uncertain sets."""

from .batch import EpisodeBatch
from .bootstrap import unit_interval
from .disturb import SEVERITIES, Disturbance, Kind, Measured, hold_missing, standard_disturbances
from .errors import ErrorSummary, error_percent, error_rms, error_spectrum, summarise
from .robustness import DisturbedEpisodes, robustness_rows

__all__ = [
    "SEVERITIES",
    "Disturbance",
    "DisturbedEpisodes",
    "EpisodeBatch",
    "ErrorSummary",
    "Kind",
    "Measured",
    "error_percent",
    "error_rms",
    "error_spectrum",
    "hold_missing",
    "robustness_rows",
    "standard_disturbances",
    "summarise",
    "unit_interval",
]
