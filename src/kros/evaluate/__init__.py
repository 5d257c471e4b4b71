"""Evaluation: errors and spectra of estimates and free runs against recordings, also of disturbed ones; Monte Carlo over uncertain sets.

Examples
--------
>>> import numpy as np
>>> from kros.evaluate import error_percent, error_rms
>>> recorded = np.array([0.0, 2.0, -4.0]).reshape(3, 1, 1)  # sample, episode, channel
>>> estimated, lengths = recorded + 0.1, np.array([3])
>>> error_rms(estimated, recorded, lengths).round(9).tolist(), error_percent(estimated, recorded, lengths).round(9).tolist()
([[0.1]], [[2.5]])
"""

from .contractions import Contractions
from .disturb import SEVERITIES, Disturbance, Kind, Measured, hold_missing, standard_disturbances
from .errors import ErrorSummary, error_percent, error_rms, error_spectrum, summarise
from .intervals import draw_interval, interval_rows, mean_intervals, unit_interval
from .monte_carlo import MonteCarlo, sample_errors
from .next_unit import draw_reserve, fewest_units, next_unit_bound
from .robustness import DisturbedEpisodes, robustness_rows, severity_of_growth
from .sensor import as_arriving, as_shown
from .truth import TrueErrors, delay_samples, true_errors

__all__ = [
    "SEVERITIES",
    "Contractions",
    "Disturbance",
    "DisturbedEpisodes",
    "ErrorSummary",
    "Kind",
    "Measured",
    "MonteCarlo",
    "TrueErrors",
    "as_arriving",
    "as_shown",
    "delay_samples",
    "draw_interval",
    "draw_reserve",
    "error_percent",
    "error_rms",
    "error_spectrum",
    "fewest_units",
    "hold_missing",
    "interval_rows",
    "mean_intervals",
    "next_unit_bound",
    "robustness_rows",
    "sample_errors",
    "severity_of_growth",
    "standard_disturbances",
    "summarise",
    "true_errors",
    "unit_interval",
]
