"""The observer at run time: one-step predictor with retraction and re-lifting, and the baselines it is compared with.

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

from .certificate.certificate import ReliftCertificate, ReliftStatus, relift_certificate
from .certificate.error import ReliftScales
from .estimator.build import identify_estimator
from .estimator.rows import Recordings, spread
from .estimator.settings import EstimatorSettings
from .observer import Observer
from .residual import like_measurement_noise, one_step_residual, residual_covariance
from .running import Estimate, RunningObserver
from .runtime import Runtime, Seen
from .screen import SampleStatus, Screen, screened
from .sensor import Sensor, Sensors, delay_of, require_measured
from .simulate import run_innovations, run_observer
from .units import factors, recorded_channel, recorded_factors

__all__ = [
    "Estimate",
    "EstimatorSettings",
    "Observer",
    "Recordings",
    "ReliftCertificate",
    "ReliftScales",
    "ReliftStatus",
    "RunningObserver",
    "Runtime",
    "SampleStatus",
    "Seen",
    "Sensor",
    "identify_estimator",
    "relift_certificate",
    "run_observer",
]
