"""The observer as it runs: one-step predictor with retraction and re-lifting, and the baselines it is compared with."""

from .baselines import kalman_candidates, noise_covariances
from .observer import Observer
from .simulate import run_observer

__all__ = ["Observer", "kalman_candidates", "noise_covariances", "run_observer"]
