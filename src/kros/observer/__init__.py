"""The observer as it runs: one-step predictor with retraction and re-lifting, and the baselines it is compared with."""

from .baselines import kalman_candidates, noise_covariances
from .observer import Observer
from .residual import mean_error_dynamics, one_step_residual, residual_spectra
from .simulate import run_observer

__all__ = [
    "Observer",
    "kalman_candidates",
    "mean_error_dynamics",
    "noise_covariances",
    "one_step_residual",
    "residual_spectra",
    "run_observer",
]
