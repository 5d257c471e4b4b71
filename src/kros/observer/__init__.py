"""The observer as it runs: one-step predictor with retraction and re-lifting, and the baselines it is compared with."""

from .baselines.difference import FilteredDifference, cutoffs_hz, rates
from .baselines.extended_kalman import ExtendedKalman, start_covariance
from .baselines.kalman import kalman_candidates, luenberger_candidates, noise_covariances
from .baselines.learned import Features, Learned, Moments
from .driven import driven_coordinates, refit_measured_rows, with_memory
from .memory import Past, observer_with_memory, remembering_observer, tune_memory
from .observer import Observer
from .phase_lock import Tracked, track_parameter
from .relift.adversary import Attack, attack, attack_running
from .relift.certificate import ReliftCertificate, relift_certificate
from .relift.error import ReliftScales
from .relift.rows import ReliftRow, relift_report
from .relift.status import Dropped, ReliftStatus
from .residual import mean_error_dynamics, one_step_residual, residual_spectra
from .residual_design import ResidualModel, one_step_rows, residual_models
from .runtime import Estimate, Runtime
from .screen import SampleStatus, Seen, sample_status
from .simulate import run_observer, run_observers
from .tune import Tuned, tune_observer

__all__ = [
    "Attack",
    "Dropped",
    "Estimate",
    "ExtendedKalman",
    "Features",
    "FilteredDifference",
    "Learned",
    "Moments",
    "Observer",
    "Past",
    "ReliftCertificate",
    "ReliftRow",
    "ReliftScales",
    "ReliftStatus",
    "ResidualModel",
    "Runtime",
    "SampleStatus",
    "Seen",
    "Tracked",
    "Tuned",
    "attack",
    "attack_running",
    "cutoffs_hz",
    "driven_coordinates",
    "kalman_candidates",
    "luenberger_candidates",
    "mean_error_dynamics",
    "noise_covariances",
    "observer_with_memory",
    "one_step_residual",
    "one_step_rows",
    "rates",
    "refit_measured_rows",
    "relift_certificate",
    "relift_report",
    "remembering_observer",
    "residual_models",
    "residual_spectra",
    "run_observer",
    "run_observers",
    "sample_status",
    "start_covariance",
    "track_parameter",
    "tune_memory",
    "tune_observer",
    "with_memory",
]
