"""The observer as it runs: one-step predictor with retraction and re-lifting, and the baselines it is compared with.

Examples
--------
>>> import numpy as np
>>> from kros.lifting import Lifting
>>> from kros.observer import Observer
>>> plant = Observer.open_loop("lag", Lifting(("x",)), np.array([[0.5]]), np.ones((1, 1)), (0,), ("u",), 0.01)
>>> running = plant.start([1.0])
>>> [float(running.step([x], [0.0])["x"]) for x in (1.0, 0.5)]
[0.5, 0.25]
"""

from .baselines.difference import FilteredDifference, cutoffs_hz, followed, rates
from .baselines.extended_kalman import ExtendedKalman, start_covariance
from .baselines.kalman import kalman_candidates, like_measurement_noise, luenberger_candidates, noise_covariances
from .baselines.learned import Features, Learned
from .baselines.learned_moments import Choice, Moments
from .certificate.certificate import ReliftCertificate, relift_certificate
from .certificate.error import ReliftScales
from .certificate.mean_square import DropoutBound, dropout_bound
from .certificate.report import ReliftRow, relift_report
from .certificate.signals import SignalBound, signal_bound
from .certificate.status import Dropped, ReliftStatus
from .limits import Limit, Limits
from .monitor import Monitor, octaves
from .observer import Observer
from .predictor import PastMoments, conditioned, driven_coordinates, identify_predictor, with_internal, with_limits
from .residual.models import ResidualModel, one_step_rows, residual_models
from .residual.one_step import mean_error_dynamics, one_step_residual, residual_spectra
from .running import Estimate, RunningObserver
from .runtime import Runtime, Seen
from .samples import SampleStatus
from .screen import sample_status
from .sensor import Sensor, Sensors
from .simulate import EstimateKind, run_innovations, run_observer, run_observers
from .tracking import Tracked, track_parameter
from .tuning.observer_rows import tune_observer
from .units import in_sizes

__all__ = [
    "Choice",
    "DropoutBound",
    "Dropped",
    "Estimate",
    "EstimateKind",
    "ExtendedKalman",
    "Features",
    "FilteredDifference",
    "Learned",
    "Limit",
    "Limits",
    "Moments",
    "Monitor",
    "Observer",
    "PastMoments",
    "ReliftCertificate",
    "ReliftRow",
    "ReliftScales",
    "ReliftStatus",
    "ResidualModel",
    "RunningObserver",
    "Runtime",
    "SampleStatus",
    "Seen",
    "Sensor",
    "Sensors",
    "SignalBound",
    "Tracked",
    "conditioned",
    "cutoffs_hz",
    "driven_coordinates",
    "dropout_bound",
    "followed",
    "identify_predictor",
    "in_sizes",
    "kalman_candidates",
    "like_measurement_noise",
    "luenberger_candidates",
    "mean_error_dynamics",
    "noise_covariances",
    "octaves",
    "one_step_residual",
    "one_step_rows",
    "rates",
    "relift_certificate",
    "relift_report",
    "residual_models",
    "residual_spectra",
    "run_innovations",
    "run_observer",
    "run_observers",
    "sample_status",
    "signal_bound",
    "start_covariance",
    "track_parameter",
    "tune_observer",
    "with_internal",
    "with_limits",
]
