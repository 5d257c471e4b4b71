r"""Loads as signals: what a mounted load asks of a machine, and which part of a load a position measurement shows.

A drive under integral control stands at its target whatever it carries. The torque tau_0 that it holds at the start
leaves no trace in positions and targets: tau and tau - tau_0 look the same. What can be seen is the change since the
start, and with a leak, which keeps estimates from drifting, its high-passed part

.. math:: \tau_s(k) = p\,\tau_s(k-1) + \tau(k) - \tau(k-1), \qquad \tau_s(0) = 0, \quad p = e^{-T/T_\ell},

with the time T_l after which a constant load is forgotten.

*The paper's estimate* (section IV-E.2) is the current's error of an observer of the unloaded machine under load,
``tau = K (i - i_hat)``. An observer that knows the current under load hides the load.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core import Array, ArrayLike, ConfigError, DataError


def low_passed(signal: ArrayLike, corner_hz: float, sample_period_s: float) -> Array:
    """Return signals below a corner without delay: Butterworth of order four, forward and backward."""
    from scipy.signal import butter, sosfiltfilt

    top = 0.5 / sample_period_s
    if not 0 < corner_hz < top:
        raise ConfigError(f"Low-pass at {corner_hz:g} Hz: the corner should lie between 0 and {top:g} Hz.")
    sections = butter(4, corner_hz, fs=1 / sample_period_s, output="sos")
    return sosfiltfilt(sections, np.asarray(signal, dtype=float), axis=0)


def without_level(signal: ArrayLike, level_s: float, sample_period_s: float) -> Array:
    """Return the part of signals that can be seen: their change since the start, forgotten after `level_s`."""
    from scipy.signal import lfilter

    signal = np.asarray(signal, dtype=float)
    return lfilter([1.0, -1.0], [1.0, -np.exp(-sample_period_s / level_s)], signal - signal[:1], axis=0)


def known_load(
    position: ArrayLike,
    sample_period_s: float,
    moment: float,
    inertia: float = 0.0,
    corner_hz: float = 20.0,
) -> Array:
    """Return the torque of a mounted mass, ``moment sin(position) + inertia position''``, position in rad."""
    position = np.asarray(position, dtype=float)
    load = moment * np.sin(position)
    if inertia:
        acceleration = np.zeros_like(position)
        acceleration[1:-1] = np.diff(position, n=2, axis=0) / sample_period_s**2
        load = load + inertia * low_passed(acceleration, corner_hz, sample_period_s)
    return load


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
    estimate: ArrayLike, load: ArrayLike, sample_period_s: float, corner_hz: float = 5.0, skip: int = 0
) -> LoadAccuracy:
    """Judge estimates of the load, shape (n_samples, batch), against known ones."""
    truth = np.asarray(load, dtype=float)
    loaded = np.any(truth != 0, axis=0)
    if loaded.all() or not loaded.any():
        count = f"{int(loaded.sum())} of {len(loaded)}"
        raise DataError(f"Load accuracy: needs episodes with and without load, found {count} with load.")
    slow = low_passed(truth, corner_hz, sample_period_s)[skip:]
    error = low_passed(estimate, corner_hz, sample_period_s)[skip:] - slow
    signals = error[:, ~loaded], error[:, loaded], slow[:, loaded]
    return LoadAccuracy(*(float(np.sqrt(np.mean(signal**2))) for signal in signals))


@dataclass(frozen=True)
class TorqueScale:
    """Torque of a current's error."""

    torque_constant: float  # torque per unit of current
    bias: float  # error of the current without load, in units of current

    @classmethod
    def calibrated(
        cls, error: ArrayLike, known: ArrayLike, sample_period_s: float, corner_hz: float = 5.0, skip: int = 300
    ) -> TorqueScale:
        """Return the scale from the error of a current and a known load by least squares of low-passed signals."""
        x, t = (low_passed(s, corner_hz, sample_period_s)[skip:].ravel() for s in (error, known))
        covariance = np.cov(x, t)
        if not covariance[0, 1] > 0:
            found = f"deviations {t.std():.3g} and {x.std():.3g} and covariance {covariance[0, 1]:.3g}"
            raise DataError(f"Torque constant: the current's error should follow the load, found {found}; check signs.")
        constant = float(covariance[0, 1] / covariance[0, 0])
        return cls(constant, float(x.mean() - t.mean() / constant))

    def load(self, error: ArrayLike) -> Array:
        """Return the load's torque, ``K (i - i_hat - bias)``, from measured minus estimated current."""
        return self.torque_constant * (np.asarray(error, dtype=float) - self.bias)
