r"""The paper's estimate (section IV-E.2): the current's error of an observer of the unloaded machine under load.

Where the current is recorded, ``tau = K (i - i_hat)``: the current in excess of what the unloaded machine would need
for this motion. K is the torque constant; one known load gives it by least squares on signals low-passed without delay,
together with a constant that takes up a bias. An observer that knows the current under load better than its unloaded
model does hides the load: use one that follows the unloaded model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from .signals import low_passed

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class TorqueScale:
    """Torque of a current's error.

    Parameters
    ----------
    torque_constant : float
        Torque per unit of current.
    bias : float
        Error of the current without load, in units of current.
    residual_percent : float
        What is left of the known load, low-passed, in percent of its deviation from its mean.

    Examples
    --------
    >>> from kros.motor_drive import TorqueScale, load_from_current
    >>> scale = TorqueScale(torque_constant=50.0, bias=0.1, residual_percent=3.0)
    >>> load_from_current([0.5], [0.2], scale).round(9).tolist()
    [10.0]
    """

    torque_constant: float
    bias: float
    residual_percent: float


def calibrate_torque(
    error: npt.ArrayLike, known: npt.ArrayLike, sample_period_s: float, corner_hz: float = 5.0, skip: int = 300
) -> TorqueScale:
    """Find the torque constant from recordings under a known load.

    Parameters
    ----------
    error : array_like, shape (n_samples, ...)
        Measured minus estimated current.
    known : array_like, shape (n_samples, ...)
        Torque of the load (`known_load`).
    sample_period_s : float
    corner_hz : float
    skip : int
        Samples at the start that do not count.

    Raises
    ------
    DataError
        When the known load does not change, or the error does not follow it.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.motor_drive import calibrate_torque
    >>> known = np.sin(2 * np.pi * 0.5 * 0.001 * np.arange(8000))  # N m
    >>> scale = calibrate_torque(0.1 + known / 50, known, 0.001)
    >>> round(scale.torque_constant), round(scale.bias, 3)
    (50, 0.1)
    """
    x, t = (low_passed(s, corner_hz, sample_period_s)[skip:].ravel() for s in (error, known))
    dx, dt = x - x.mean(), t - t.mean()
    if not dt @ dt > 0 or not dx @ dt > 0:
        raise DataError(
            f"Torque constant: the known load should change and the current's error follow it; found deviations "
            f"{t.std():.3g} and {x.std():.3g} "
            f"and covariance {dx @ dt / len(t):.3g}; check signs, and that the observer is one of the unloaded machine."
        )
    constant = float(dx @ dt / (dx @ dx))
    left = dt - constant * dx
    return TorqueScale(constant, float(x.mean() - t.mean() / constant), float(100 * np.sqrt(left @ left / (dt @ dt))))


def load_from_current(measured: npt.ArrayLike, estimated: npt.ArrayLike, scale: TorqueScale) -> Array:
    """Return the load's torque, ``K (i - i_hat - bias)``, shape of the currents.

    Examples
    --------
    >>> from kros.motor_drive import TorqueScale, load_from_current
    >>> load_from_current([0.5, 0.3], [0.2, 0.2], TorqueScale(50.0, bias=0.1, residual_percent=3.0)).round(9).tolist()
    [10.0, -0.0]
    """
    error = np.asarray(measured, dtype=float) - np.asarray(estimated, dtype=float)
    return scale.torque_constant * (error - scale.bias)


@dataclass(frozen=True)
class LoadAccuracy:
    """Errors of a load estimate, low-passed, in units of the load."""

    floor_rms: float  # Of the estimate on episodes without load
    error_rms: float  # Under load
    load_rms: float  # Of the load itself

    @property
    def ratio(self) -> float:
        """Error under load to the floor."""
        return self.error_rms / self.floor_rms

    @property
    def percent(self) -> float:
        """Error under load in percent of the load."""
        return 100 * self.error_rms / self.load_rms


def load_accuracy(
    estimate: npt.ArrayLike, load: npt.ArrayLike, sample_period_s: float, corner_hz: float = 5.0, skip: int = 0
) -> LoadAccuracy:
    """Judge estimates of the load, shape (n_samples, batch), against known ones."""
    truth = np.asarray(load, dtype=float)
    loaded = np.any(truth != 0, axis=0)
    if loaded.all() or not loaded.any():
        raise DataError(
            f"Load accuracy: needs episodes with and without load, found {int(loaded.sum())} of {len(loaded)} "
            f"with load."
        )
    slow = low_passed(truth, corner_hz, sample_period_s)[skip:]
    error = low_passed(estimate, corner_hz, sample_period_s)[skip:] - slow

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return LoadAccuracy(rms(error[:, ~loaded]), rms(error[:, loaded]), rms(slow[:, loaded]))
