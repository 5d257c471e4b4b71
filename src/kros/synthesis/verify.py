r"""Poles of the observer on the nominal machine and on every unit.

With the observer running on unit k the closed loop is block triangular: the unit does not see the observer,

    [ x_k   ]+   [ A_k             0                  0        ] [ x_k   ]
    [ x_hat ]  = [ J D^c C         A - J D^c C        J C^c    ] [ x_hat ]
    [ x_c   ]    [ B^c C          -B^c C              A^c      ] [ x_c   ]

so its poles are the unit's and those of the nominal observer loop. *They say nothing about robustness*: no unit, however different, can make
the loop unstable. What differs between units is the size of the error, and that is what the certificates bound.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from ..core.lti import StateSpace
from .result import Injection

Array = npt.NDArray[Any]


def observer_loop(nominal: StateSpace, C: npt.ArrayLike, controller: StateSpace, injection: Injection) -> Array:
    """State matrix of the nominal observer's error dynamics, shape (n + n_c, n + n_c)."""
    C, J = _checked(nominal, C, controller, injection)
    K = controller
    return np.block([[nominal.A - J @ K.D @ C, -J @ K.C], [K.B @ C, K.A]])


def closed_loop(units: StateSpace, nominal: StateSpace, C: npt.ArrayLike, controller: StateSpace, injection: Injection) -> Array:
    """State matrix of unit and observer together, shape (..., 2n + n_c, 2n + n_c), for one unit or a batch.

    Parameters
    ----------
    units : StateSpace
        One model or a batch with the unit axis first; only A is used.
    nominal : StateSpace
    C : array_like, shape (q, n)
    controller : StateSpace
        In physical units.
    injection : Injection
    """
    C, J = _checked(nominal, C, controller, injection)
    K, n = controller, nominal.n_states
    batch = units.A.shape[:-2]
    size = 2 * n + K.n_states
    matrix = np.zeros((*batch, size, size))
    matrix[..., :n, :n] = units.A
    matrix[..., n:, :n] = np.vstack([J @ K.D @ C, K.B @ C])
    matrix[..., n:, n:] = np.block([[nominal.A - J @ K.D @ C, J @ K.C], [-K.B @ C, K.A]])
    return matrix


def spectral_radius_max(units: StateSpace, nominal: StateSpace, C: npt.ArrayLike, controller: StateSpace, injection: Injection) -> float:
    """Largest pole magnitude over the nominal observer loop and all units; see the module for what it does not say."""
    return float(np.abs(np.linalg.eigvals(closed_loop(units, nominal, C, controller, injection))).max())


def _checked(nominal: StateSpace, C: npt.ArrayLike, K: StateSpace, injection: Injection) -> tuple[Array, Array]:
    matrix = np.atleast_2d(np.asarray(C, dtype=float))
    if injection is Injection.NONE:
        raise DimensionError("Observer loop: injection should be INPUT or STATE, found NONE.")
    J = nominal.B if injection is Injection.INPUT else np.eye(nominal.n_states)
    if matrix.shape[1] != nominal.n_states or (K.n_outputs, K.n_inputs) != (J.shape[1], matrix.shape[0]) or K.dt != nominal.dt:
        raise DimensionError(
            f"Observer loop ({injection.value} injection): needs a controller of {J.shape[1]} x {matrix.shape[0]} at {nominal.dt} s and C with "
            f"{nominal.n_states} columns, found {K.n_outputs} x {K.n_inputs} at {K.dt} s and C of shape {matrix.shape}."
        )
    return matrix, J
