r"""How well a load is estimated: slow errors against the same estimator's floor without load, and what is left of the gearbox's ripple.

Slow errors are of estimate and truth low-passed without delay. The ripple is taken in the moving band of the gear: with r the ratio,
``estimate exp(-j r theta)`` low-passed is the amplitude that turns with the gear, at any speed; it counts where its frequency ``r |speed|`` is
above a least one, where it cannot be taken for load.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from .signals import low_passed

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class LoadAccuracy:
    """Errors of a load estimate, low-passed, in units of the load.

    Parameters
    ----------
    floor_rms : float
        Of the estimate on episodes without load.
    error_rms : float
        Under load.
    load_rms : float
        Of the load itself.
    """

    floor_rms: float
    error_rms: float
    load_rms: float

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
    """Judge estimates of the load, shape (n_samples, batch), against known ones; episodes whose load is zero throughout give the floor.

    Parameters
    ----------
    estimate, load : array_like, shape (n_samples, batch)
    sample_period_s : float
    corner_hz : float
    skip : int
        Samples at the start that do not count.

    Raises
    ------
    DataError
        When there are no episodes with load, or none without.
    """
    truth = np.asarray(load, dtype=float)
    loaded = np.any(truth != 0, axis=0)
    if loaded.all() or not loaded.any():
        raise DataError(f"Load accuracy: needs episodes with and without load, found {int(loaded.sum())} of {len(loaded)} with load.")
    slow = low_passed(truth, corner_hz, sample_period_s)[skip:]
    error = low_passed(estimate, corner_hz, sample_period_s)[skip:] - slow

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return LoadAccuracy(rms(error[:, ~loaded]), rms(error[:, loaded]), rms(slow[:, loaded]))


def ripple_power(
    signal: npt.ArrayLike,
    position: npt.ArrayLike,
    speed: npt.ArrayLike,
    ratio: float,
    sample_period_s: float,
    least_hz: float = 15.0,
    width_hz: float = 5.0,
) -> Array:
    """Return the power of what turns with the gear, shape (batch,), the signal's unit squared.

    Parameters
    ----------
    signal : array_like, shape (n_samples, batch)
    position, speed : array_like, shape (n_samples, batch), rad and rad/s
    ratio : float
        Ripples a turn.
    sample_period_s : float
    least_hz : float
        Frequency above which the ripple counts.
    width_hz : float
        Half the width of the moving band.

    Raises
    ------
    DataError
        When an episode never turns so fast.
    """
    x, theta = np.asarray(signal, dtype=float), np.asarray(position, dtype=float)
    real, imaginary = (low_passed(part, width_hz, sample_period_s) for part in (x * np.cos(ratio * theta), -x * np.sin(ratio * theta)))
    fast = ratio * np.abs(np.asarray(speed, dtype=float)) / (2 * np.pi) > least_hz
    if not fast.any(axis=0).all():
        raise DataError(f"Ripple of the gear: an episode never turns so fast that the ripple is above {least_hz:g} Hz; leave it out.")
    return np.asarray(2 * np.sum(real**2 + imaginary**2, axis=0, where=fast) / fast.sum(axis=0))
