"""Linear drives of several tests: populations under a cascaded loop, and the servo of observer problems."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from kros.core import StateSpace

DT = 1e-3


def drives(n_units: int, seed: int, outlier: bool = False) -> StateSpace:
    """Position, velocity and current, from targets of position and velocity; parameters are spread by 5-15 %.

    The outlier, last, is loosely fastened: more friction, less torque, slower current.
    """
    rng = np.random.default_rng(seed)
    A, B = np.zeros((n_units, 3, 3)), np.zeros((n_units, 3, 2))
    for k in range(n_units):
        inertia, friction, torque, lag = np.array([0.5, 6.0, 40.0, 2e-3]) * np.exp(
            np.array([0.05, 0.15, 0.05, 0.1]) * rng.normal(size=4)
        )
        if outlier and k == n_units - 1:
            inertia, friction, torque, lag = 1.5 * inertia, 2.5 * friction, 0.6 * torque, 2 * lag
        a = np.array([[-0.5, 1, 0], [0, -friction / inertia, torque / inertia], [-14.4 / lag, -1.2 / lag, -1 / lag]])
        b = np.array([[0.5, 0], [0, 0], [14.4 / lag, 1.3 / lag]])
        step = expm(np.block([[a, b], [np.zeros((2, 5))]]) * DT)
        A[k], B[k] = step[:3, :3], step[:3, 3:]
    return StateSpace(A, B, np.broadcast_to(np.eye(3), A.shape), np.zeros(B.shape), DT)


def servo(rng: np.random.Generator) -> StateSpace:
    """A drive with a lifted state, its parameters spread by a tenth."""
    kt, b, kp, kv, wc = np.array([60, 3, 12, 3, 600]) * np.exp(0.1 * rng.standard_normal(5))
    A = np.array([[0, 1, 0, 0], [0, -b, kt, 2], [-wc * kv * kp, -wc * kv, -wc, 0], [0.5, 1, 0, -30]])
    B = np.array([[0, 0], [0, 0], [wc * kv * kp, wc * kv], [0, 0]])
    M = expm(DT * np.block([[A, B], [np.zeros((2, 6))]]))
    return StateSpace(M[:4, :4], M[:4, 4:], np.eye(4), np.zeros((4, 2)), DT)


def lag(low: float, high: float, corner_hz: float) -> StateSpace:
    """A weight of order one that goes from one gain to another."""
    a = np.exp(-2 * np.pi * corner_hz * DT)
    d, c = np.linalg.solve([[1, 1 / (1 - a)], [1, -1 / (1 + a)]], [low, high])
    return StateSpace([[a]], [[1.0]], [[c]], [[d]], DT)
