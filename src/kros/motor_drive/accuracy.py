"""How well a load is estimated: slow errors against the same estimator's floor without load."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from .signals import low_passed

Array = npt.NDArray[np.float64]


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
