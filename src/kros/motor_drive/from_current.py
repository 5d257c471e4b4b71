r"""The paper's estimate (section IV-E.2): the current's error of an observer of the unloaded machine under load.

Where the current is recorded, ``tau = K (i - i_hat)``: the current in excess of what the unloaded machine would need
for this motion. The observer has to follow the unloaded model: one that knows the current under load hides the load.
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
    >>> import numpy as np
    >>> from kros.motor_drive import TorqueScale
    >>> known = np.sin(2 * np.pi * 0.5 * 0.001 * np.arange(8000))  # N m
    >>> scale = TorqueScale.calibrated(0.1 + known / 50, known, 0.001)
    >>> round(scale.torque_constant), round(scale.bias, 3), round(float(scale.load(0.3)), 6)
    (50, 0.1, 10.0)
    """

    torque_constant: float
    bias: float
    residual_percent: float

    @classmethod
    def calibrated(
        cls,
        error: npt.ArrayLike,
        known: npt.ArrayLike,
        sample_period_s: float,
        corner_hz: float = 5.0,
        skip: int = 300,
    ) -> TorqueScale:
        """Return the scale from measured minus estimated current under a known load, by least squares with a bias.

        Parameters
        ----------
        error, known : array_like, shape (n_samples, ...)
            Of the current, and the torque of the load (`known_load`).
        sample_period_s : float
        corner_hz : float
            Both signals are low-passed without delay.
        skip : int
            Samples at the start that do not count.

        Raises
        ------
        DataError
            When the known load does not change, or the error does not follow it.
        """
        x, t = (low_passed(s, corner_hz, sample_period_s)[skip:].ravel() for s in (error, known))
        dx, dt = x - x.mean(), t - t.mean()
        if not dt @ dt > 0 or not dx @ dt > 0:
            raise DataError(
                f"Torque constant: the known load should change and the current's error follow it; found deviations "
                f"{t.std():.3g} and {x.std():.3g} and covariance {dx @ dt / len(t):.3g}; check signs, and that the "
                "observer is one of the unloaded machine."
            )
        constant = float(dx @ dt / (dx @ dx))
        rest = dt - constant * dx
        residual = float(100 * np.sqrt(rest @ rest / (dt @ dt)))
        return cls(constant, float(x.mean() - t.mean() / constant), residual)

    def load(self, error: npt.ArrayLike) -> Array:
        """Return the load's torque, ``K (i - i_hat - bias)``, from measured minus estimated current."""
        return self.torque_constant * (np.asarray(error, dtype=float) - self.bias)
