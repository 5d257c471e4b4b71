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

from .baselines.difference import FilteredDifference
from .baselines.extended_kalman import ExtendedKalman
from .certificate.certificate import ReliftCertificate, relift_certificate
from .certificate.error import ReliftScales
from .certificate.mean_square import DropoutBound, dropout_bound
from .certificate.signals import SignalBound, signal_bound
from .certificate.status import Dropped, ReliftStatus
from .monitor import Monitor
from .observer import Observer
from .predictor.build import identify_predictor
from .predictor.driven import driven_coordinates, with_internal
from .predictor.limited import conditioned
from .predictor.moments import PastMoments
from .residual.models import residual_models
from .running import Estimate, RunningObserver
from .runtime import Runtime, Seen
from .samples import SampleStatus
from .screen import sample_status
from .sensor import Sensor
from .simulate import EstimateKind, run_observer, run_observers
from .tracking import Tracked, track_parameter
from .tuning.observer_rows import tune_observer
from .units import in_sizes

__all__ = [
    "DropoutBound",
    "Dropped",
    "Estimate",
    "EstimateKind",
    "ExtendedKalman",
    "FilteredDifference",
    "Monitor",
    "Observer",
    "PastMoments",
    "ReliftCertificate",
    "ReliftScales",
    "ReliftStatus",
    "RunningObserver",
    "Runtime",
    "SampleStatus",
    "Seen",
    "Sensor",
    "SignalBound",
    "Tracked",
    "conditioned",
    "driven_coordinates",
    "dropout_bound",
    "identify_predictor",
    "in_sizes",
    "relift_certificate",
    "residual_models",
    "run_observer",
    "run_observers",
    "sample_status",
    "signal_bound",
    "track_parameter",
    "tune_observer",
    "with_internal",
]
