r"""Loads as signals: what a known load asks of a machine, and which part of any load a position measurement can tell.

A drive under integral control stands at its target whatever it carries. The torque tau_0 that it holds at the start
leaves no trace in positions and targets, then or later: tau and tau - tau_0 look the same. What can be seen is the
change since the start, and with a leak, which keeps estimates from drifting, its high-passed part

.. math:: \tau_s(k) = p\,\tau_s(k-1) + \tau(k) - \tau(k-1), \qquad \tau_s(0) = 0, \quad p = e^{-T/T_\ell},

with the time T_l after which a constant load is forgotten. `AngleLoad` brings the level back where the load is fixed to
an angle.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError

Array = npt.NDArray[np.float64]
_ORDER = 4


def low_passed(signal: npt.ArrayLike, corner_hz: float, sample_period_s: float) -> Array:
    """Return signals without what is faster than a corner, and without delay: Butterworth, forward and backward."""
    from scipy.signal import butter, sosfiltfilt

    if not 0 < corner_hz < 0.5 / sample_period_s:
        raise ConfigError(
            f"Low-pass at {corner_hz:g} Hz: the corner should lie between 0 and {0.5 / sample_period_s:g} Hz."
        )
    filtered: Array = sosfiltfilt(
        butter(_ORDER, corner_hz, fs=1 / sample_period_s, output="sos"), np.asarray(signal, dtype=float), axis=0
    )
    return filtered


def without_level(signal: npt.ArrayLike, level_s: float, sample_period_s: float) -> Array:
    """Return the part of signals that can be seen: their change since the start, forgotten after `level_s`."""
    from scipy.signal import lfilter

    signal = np.asarray(signal, dtype=float)
    changed: Array = lfilter(
        [1.0, -1.0], [1.0, -float(np.exp(-sample_period_s / level_s))], signal - signal[:1], axis=0
    )
    return changed


def known_load(
    position: npt.ArrayLike,
    sample_period_s: float,
    moment: float,
    inertia: float = 0.0,
    angle_rad: float = 0.0,
    corner_hz: float = 20.0,
) -> Array:
    """Return the torque that a mounted mass of known size takes, ``moment sin(position - angle) + inertia position''``.

    Parameters
    ----------
    position : array_like, shape (n_samples, ...), rad
        Recorded; its second difference is low-passed without delay.
    sample_period_s : float
    moment : float
        Mass times gravity times lever arm, in any unit of torque, or divided by the torque constant: then the load is
        in units of current.
    inertia : float
        Of the load, the same unit times s^2/rad.
    angle_rad : float
        Position at which the mass hangs at rest.
    corner_hz : float
        Of the acceleration.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.motor_drive import known_load
    >>> known_load([0.0, np.pi / 2], 0.001, moment=0.2).round(9).tolist()  # a mass that hangs, and one held out
    [0.0, 0.2]
    """
    position = np.asarray(position, dtype=float)
    load = moment * np.sin(position - angle_rad)
    if inertia:
        acceleration = np.zeros_like(position)
        acceleration[1:-1] = np.diff(position, n=2, axis=0) / sample_period_s**2
        load = load + inertia * low_passed(acceleration, corner_hz, sample_period_s)
    return np.asarray(load, dtype=float)
