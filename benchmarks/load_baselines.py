r"""Disturbance observers from a model: the load as a state that wanders, and a Kalman predictor for both.

With the one-step model ``x+ = A_s x + a sigma(x) + B_s u`` of the unloaded machine, a load tau adds ``E tau``,

    [ x   ]+   [ A_s  E  ] [ x   ]   [ a ]            [ B_s ]
    [ tau ]  = [ 0   rho ] [ tau ] + [ 0 ] sigma(x) + [ 0   ] u + w,      rho = exp(-2 pi f_c T),

and the residual of recordings under a known load gives E by least squares. For rho = 1 the steady state under a constant load is exact: the
innovation has no mean, so neither has the error of anything that it determines. This asks more of the model than `load_observer`
does, namely that its states, the controller's integrator among them, are the machine's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from kros.core.lti import gain
from kros.motor_drive.observer import LOAD
from kros.motor_drive.signals import low_passed
from kros.observer import Observer
from kros.synthesis.result import Injection
from kros.synthesis.riccati.h2 import kalman

Array = npt.NDArray[np.float64]


def load_direction(residual: npt.ArrayLike, load: npt.ArrayLike) -> Array:
    """How a load (n_samples, ...) enters the one-step residual (n_samples, ..., n): E of shape (n,), by least squares."""
    omega, tau = np.asarray(residual, dtype=float), np.asarray(load, dtype=float).ravel()
    omega, tau = omega.reshape(-1, omega.shape[-1]), tau - tau.mean()
    return np.asarray((omega - omega.mean(axis=0)).T @ tau / (tau @ tau))


def disturbance_observer(
    name: str,
    observer: Observer,
    direction: npt.ArrayLike,
    process: npt.ArrayLike,
    noise: npt.ArrayLike,
    wander: float,
    corner_hz: float = 0.0,
    parameters: Mapping[str, float] | None = None,
) -> Observer:
    """A Kalman predictor for the states of `observer` and the load; noise and wander are standard deviations."""
    lifting, E = observer.lifting, np.asarray(direction, dtype=float)
    n, functions = lifting.n_states, len(lifting.functions)
    rho = float(np.exp(-2 * np.pi * corner_hz * observer.sample_period_s))
    states = np.block([[observer.A[:n, :n], E[:, None]], [np.zeros((1, n)), np.array([[rho]])]])
    Q = np.zeros((n + 1, n + 1))
    Q[:n, :n], Q[n, n] = process, wander**2
    C = np.eye(n + 1)[list(observer.measured)]
    L = kalman(states, C, Q, np.diag(np.square(noise)), observer.sample_period_s).controller.D
    silent = np.zeros((functions, n + 1 + functions))
    A = np.vstack([np.hstack([states, np.vstack([observer.A[:n, n:], np.zeros((1, functions))])]), silent])
    B = np.vstack([observer.B[:n], np.zeros((1 + functions, observer.B.shape[1]))])
    gains = gain(np.vstack([L, np.zeros((functions, len(observer.measured)))]), observer.sample_period_s)
    widened = replace(lifting, states=(*lifting.states, LOAD))
    own = {**observer.parameters, **(parameters or {})}
    return Observer(
        name, widened, A, B, observer.measured, observer.inputs, gains, Injection.STATE, observer.sample_period_s, own
    )


def ripple_power(
    signal: npt.ArrayLike,
    position: npt.ArrayLike,
    speed: npt.ArrayLike,
    ratio: float,
    sample_period_s: float,
    least_hz: float = 15.0,
    width_hz: float = 5.0,
) -> Array:
    """Power of what turns with the gear, shape (batch,), from signals (n_samples, batch); ripples a turn in `ratio`."""
    x, theta = np.asarray(signal, dtype=float), np.asarray(position, dtype=float)
    real, imaginary = (
        low_passed(part, width_hz, sample_period_s) for part in (x * np.cos(ratio * theta), -x * np.sin(ratio * theta))
    )
    fast = ratio * np.abs(np.asarray(speed, dtype=float)) / (2 * np.pi) > least_hz
    return np.asarray(2 * np.sum(real**2 + imaginary**2, axis=0, where=fast) / fast.sum(axis=0))
