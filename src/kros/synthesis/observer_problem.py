r"""The observer problem: nominal model, uncertainty weights, noise; and the error system that K shapes.

With inverse input multiplicative uncertainty :math:`E = W_L \Delta W_R` on the scaled inputs and an optional additive remainder
:math:`R = W_{rL} \Delta_r W_{rR}`, the estimation error ``e = x - x_hat`` is

.. math:: e = S\,[\,G W_L \Delta (I - W_R W_L \Delta)^{-1} W_R + R\,]\,W_u w_1 \; - \; S\,(zI - A)^{-1} J K\, n

with :math:`S = (I + (zI - A)^{-1} J K C)^{-1}` and ``J = B`` (input injection) or ``J = I`` (state injection). K is outside the loop of
:math:`\Delta`, so no choice of K can lose robustness, and none can gain it: the set is well posed when ``||W_R W_L|| < 1``.

::

     w1 -> W_u -> W_R ->(+)-> Delta -+-> W_L -> d          r = R W_u w1 (remainder)
                         ^           |          |            |
                         +-- W_R W_L +          v            v
                                     xi+ = A xi + B d - J y^c,  e = xi + r,   y = C e + n,   y^c = K y

Everything numerical happens in scaled coordinates: states over `output_scale`, inputs over `input_scale`, measurements over their noise.

Symbols
-------
A, B, C : nominal model, state = full lifted state;  J : injection matrix;  d, r, n : disturbance of the input, of the state, noise
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError, SynthesisError
from ..core.lti import StateSpace, block_diagonal, gain
from ..core.norms import hinf_norm
from .assumptions import unreachable_modes
from .generalized_plant import GeneralizedPlant
from .result import Injection

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class ObserverProblem:
    """What an observer must be good at: a nominal model, an uncertain set around it, measurement noise.

    Parameters
    ----------
    nominal : StateSpace
        Nominal model; only `A` (n, n), `B` (n, m) and `dt` are used, the state being the full lifted state.
    C : ndarray, shape (q, n)
        Selects the measured outputs from the lifted state.
    W_L : StateSpace, (m, m), diagonal
        Left weight of ``E = W_L Delta W_R`` on scaled inputs; stable.
    W_R : StateSpace, (m, m), diagonal
        Right weight; stable.
    input_scale : ndarray, shape (m,)
        Physical size of each input; scaled input = input / scale.
    output_scale : ndarray, shape (n,)
        Physical size of each (lifted) state.
    noise : ndarray, shape (q,)
        Standard deviation of the white measurement noise per sample, in the units of y; positive.
    n_original : int, optional
        The first `n_original` states are the original ones; the rest are lifted functions with no weight. Default all.
    W_u : StateSpace, (m, m), optional
        Weight of the scaled inputs; default identity: white scaled inputs of unit variance.
    W_p : ndarray, shape (p, n), optional
        Performance weight on the error in physical units; default ``1 / output_scale`` on the original states.
    correction_penalty : float
        Small weight of the scaled correction; used for input injection and `mixed`, where the problem is singular without it.
    remainder_left : StateSpace, (n, n), optional
        Left weight of the additive remainder on scaled states.
    remainder_right : StateSpace, (m, m), optional
        Right weight of the additive remainder on scaled inputs.
    injection : Injection
        Where the correction enters.
    process_noise : ndarray, shape (n,), optional
        Standard deviation of white noise on every (lifted) state per sample, independent of everything else; default none.

    Raises
    ------
    DimensionError
        When sizes or sampling periods do not fit, or a scale or noise level is not positive.
    """

    nominal: StateSpace
    C: Array
    W_L: StateSpace
    W_R: StateSpace
    input_scale: Array
    output_scale: Array
    noise: Array
    n_original: int | None = None
    W_u: StateSpace | None = None
    W_p: Array | None = None
    correction_penalty: float = 1e-3
    remainder_left: StateSpace | None = None
    remainder_right: StateSpace | None = None
    injection: Injection = Injection.STATE
    process_noise: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "C", np.atleast_2d(np.asarray(self.C, dtype=float)))
        n, m, q = self.nominal.n_states, self.nominal.n_inputs, self.C.shape[0]
        if self.C.shape[1] != n:
            raise DimensionError(
                f"Observer problem: C should be (q, {n}) for {n} lifted states, found {self.C.shape}; select rows of the identity."
            )
        if self.n_original is not None and not 1 <= self.n_original <= n:
            raise DimensionError(f"Observer problem: n_original = {self.n_original} should lie between 1 and {n}.")
        for name, size in (("input_scale", m), ("output_scale", n), ("noise", q)):
            value = np.atleast_1d(np.asarray(getattr(self, name), dtype=float))
            if value.shape != (size,) or not np.all(np.isfinite(value) & (value > 0)):
                raise DimensionError(
                    f"Observer problem: {name} should be {size} positive numbers, found {value}; noise of an encoder is its step / sqrt(12)."
                )
            object.__setattr__(self, name, value)
        level = np.zeros(n) if self.process_noise is None else np.asarray(self.process_noise, dtype=float)
        if level.shape != (n,) or not np.all(np.isfinite(level) & (level >= 0)):
            raise DimensionError(f"Observer problem: process_noise should be {n} numbers of at least zero, found {level}.")
        object.__setattr__(self, "process_noise", level)
        if self.W_p is None:
            kept = n if self.n_original is None else self.n_original
            object.__setattr__(self, "W_p", np.diag(1 / self.output_scale)[:kept])
        object.__setattr__(self, "W_p", np.atleast_2d(np.asarray(self.W_p, dtype=float)))
        if self.W_p.shape[1] != n:  # type: ignore[union-attr]
            raise DimensionError(f"Observer problem: W_p should be (p, {n}), found {self.W_p.shape}; lifted functions get zero columns.")  # type: ignore[union-attr]
        if self.correction_penalty <= 0:
            raise DimensionError(
                f"Observer problem: correction_penalty = {self.correction_penalty} should be positive; 1e-3 is the default."
            )
        if self.injection is Injection.NONE:
            raise DimensionError("Observer problem: injection should be Injection.INPUT or Injection.STATE, found NONE.")
        if (self.remainder_left is None) != (self.remainder_right is None):
            raise DimensionError("Observer problem: remainder_left and remainder_right come together, found only one of them.")
        weights = {"W_L": m, "W_R": m, "W_u": m, "remainder_left": n, "remainder_right": m}
        for name, size in weights.items():
            self._check_weight(name, size)
        for name in ("W_L", "W_R"):
            if not is_diagonal(getattr(self, name)):
                raise DimensionError(f"Observer problem: {name} should be diagonal, one filter per channel; fit a diagonal cover.")

    def _check_weight(self, name: str, size: int) -> None:
        weight: StateSpace | None = getattr(self, name)
        if weight is None:
            return
        if (weight.n_outputs, weight.n_inputs) != (size, size) or weight.batch_shape:
            raise DimensionError(
                f"Observer problem: {name} should be {size} x {size}, found {weight.n_outputs} x {weight.n_inputs}{weight.batch_shape or ''}."
            )
        if weight.dt != self.nominal.dt:
            raise DimensionError(
                f"Observer problem: {name} is sampled at {weight.dt} s, the nominal model at {self.nominal.dt} s; fit it at the model's period."
            )

    @property
    def input_weight(self) -> StateSpace:
        """W_u, the identity unless given."""
        return self.W_u if self.W_u is not None else gain(np.eye(self.nominal.n_inputs), self.nominal.dt)

    @cached_property
    def scaled(self) -> tuple[Array, Array, Array, Array]:
        """A, B, C and W_p in scaled coordinates; the measurement noise has unit covariance."""
        x, u = self.output_scale, self.input_scale
        return (
            self.nominal.A * x / x[:, None],
            self.nominal.B * u / x[:, None],
            self.C * x / self.noise[:, None],
            self.W_p * x,
        )

    def require_sound(self) -> float:
        """Check that the set is well posed and the observer possible; return ``||W_R W_L||``.

        Raises
        ------
        SynthesisError
            For an unstable nominal model or weight, an undetectable pair, or ``||W_R W_L|| >= 1``.
        """
        if self.nominal.dt == 0:
            raise SynthesisError("Observer synthesis works in discrete time, found a continuous nominal model (dt = 0); sample it.")
        modes = unreachable_modes(self.nominal.A.T, self.C.T, self.nominal.dt)
        if modes:
            raise SynthesisError(
                f"Observer synthesis: (A, C) is not detectable, mode {modes[0]:.6g} is invisible in y; measure another state."
            )
        for name in ("nominal", "W_L", "W_R", "W_u", "remainder_left", "remainder_right"):
            system: StateSpace | None = getattr(self, name)
            if system is not None and not system.is_stable():
                raise SynthesisError(
                    f"Observer synthesis: {name} has spectral radius {float(system.spectral_radius()):.9g}; it must be below 1, "
                    "use a stable model (identification guarantees it) and stable weights."
                )
        size = hinf_norm(self.W_R @ self.W_L)
        if size >= 1:
            raise SynthesisError(
                f"Observer synthesis: ||W_R W_L|| = {size:.6g} should be below 1 for inverse input multiplicative uncertainty, otherwise the set contains "
                "ill-posed plants; choose another form or nominal, or leave outlying units out."
            )
        return size

    def error_plant(self) -> GeneralizedPlant:
        """Unweighted error system in scaled coordinates: w = (d, r, n, v), z = W_p e, u = y^c, y = C e + n; v is process noise."""
        A, B, C, W_p = self.scaled
        n, m, q, p = A.shape[0], B.shape[1], C.shape[0], W_p.shape[0]
        J = B if self.injection is Injection.INPUT else np.eye(n)
        return GeneralizedPlant(
            A,
            np.hstack([B, np.zeros((n, n + q)), np.diag(self.scaled_process_noise)]),
            -J,
            W_p,
            C,
            np.hstack([np.zeros((p, m)), W_p, np.zeros((p, q + n))]),
            np.zeros((p, J.shape[1])),
            np.hstack([np.zeros((q, m)), C, np.eye(q), np.zeros((q, n))]),
            np.zeros((q, J.shape[1])),
            self.nominal.dt,
        )

    @property
    def scaled_process_noise(self) -> Array:
        """Standard deviation of the process noise over `output_scale`, shape (n,)."""
        return self.process_noise / self.output_scale

    def error_system(self, controller: StateSpace) -> StateSpace:
        """Closed error system from (d, r, n, v), scaled, to W_p e, for a controller in physical units."""
        return self.error_plant().close(self.to_scaled(controller))

    def shaped_plant(self, disturbance: StateSpace, remainder: StateSpace | None = None) -> GeneralizedPlant:
        """Regularised plant for H2: white noise through the shaping filters, penalty on the correction, w = (nu_d, nu_r, n, v)."""
        q, n, dt = self.C.shape[0], self.nominal.n_states, self.nominal.dt
        filters = [disturbance] + ([remainder] if remainder is not None else []) + [gain(np.eye(q + n), dt)]
        plant = self.error_plant()
        if remainder is None:
            m = self.nominal.n_inputs
            kept = np.r_[0:m, m + n : m + n + q + n]
            plant = GeneralizedPlant(
                plant.A, plant.B1[:, kept], plant.B2, plant.C1, plant.C2, plant.D11[:, kept], plant.D12, plant.D21[:, kept], plant.D22, dt
            )
        return penalise(shape_inputs(plant, block_diagonal(filters)), self.correction_penalty)

    def mixed_plant(self, noise_floor: float = 1e-3, penalty_floor: float = 3e-2) -> GeneralizedPlant:
        """Reduced, regularised, scaled form of (37)-(39): w1 = (inputs, n), w2 = output of Delta, z1 = (W_p e, penalty), z2 = input of Delta.

        Minimal in the error: the copies of the plant drop out. The remainder has no place in this form and is left to the certificate. With
        the noise of a good encoder the covariances span twelve decades, more than conic solvers can handle; `noise_floor` is the least noise
        here, as a fraction of the measured channel's range, `penalty_floor` the least correction penalty.
        """
        A, B, C, W_p = self.scaled
        L, R, U = self.W_L, self.W_R @ self.input_weight, self.W_R @ self.W_L
        n, m, q, p = A.shape[0], B.shape[1], C.shape[0], W_p.shape[0]
        J = B if self.injection is Injection.INPUT else np.eye(n)
        if self.W_R.n_states == 0 and self.input_weight.n_states == 0:  # no copy of W_L: z2 = W_R (W_u w1 + W_L w2)
            z2 = StateSpace(L.A, np.hstack([np.zeros((L.n_states, m)), L.B]), self.W_R.D @ L.C, np.hstack([R.D, U.D]), L.dt)
        else:
            chain = self.W_R @ StateSpace(
                block_diagonal([self.input_weight, L]).A,
                block_diagonal([self.input_weight, L]).B,
                np.hstack([self.input_weight.C, L.C]),
                np.hstack([self.input_weight.D, L.D]),
                L.dt,
            )
            z2 = chain
        k = z2.n_states
        to_d = np.zeros((m, k))  # d = W_L w2: the states of W_L are the last ones
        to_d[:, k - L.n_states :] = L.C
        n_u = J.shape[1]
        sigma = np.maximum(1.0, noise_floor * (np.abs(self.C) @ self.output_scale) / self.noise)
        B1 = np.block([[np.zeros((n, m + q)), B @ L.D], [z2.B[:, :m], np.zeros((k, q)), z2.B[:, m:]]])
        return GeneralizedPlant(
            np.block([[A, B @ to_d], [np.zeros((k, n)), z2.A]]),
            B1,
            np.vstack([-J, np.zeros((k, n_u))]),
            np.block([[W_p, np.zeros((p, k))], [np.zeros((n_u, n + k))], [np.zeros((m, n)), z2.C]]),
            np.hstack([C, np.zeros((q, k))]),
            np.block([[np.zeros((p + n_u, m + q + m))], [z2.D[:, :m], np.zeros((m, q)), z2.D[:, m:]]]),
            np.vstack([np.zeros((p, n_u)), max(self.correction_penalty, penalty_floor) * np.eye(n_u), np.zeros((m, n_u))]),
            np.hstack([np.zeros((q, m)), np.diag(sigma), np.zeros((q, m))]),
            np.zeros((q, n_u)),
            L.dt,
            n_w1=m + q,
            n_z1=p + n_u,
        )

    def _scales(self) -> tuple[Array, Array]:
        correction = self.input_scale if self.injection is Injection.INPUT else self.output_scale
        return correction, self.noise

    def to_scaled(self, controller: StateSpace) -> StateSpace:
        """Turn a controller in physical units into one in scaled coordinates."""
        out, noise = self._scales()
        K = controller
        return StateSpace(K.A, K.B * noise, K.C / out[:, None], K.D * noise / out[:, None], K.dt)

    def to_physical(self, controller: StateSpace) -> StateSpace:
        """Turn a controller in scaled coordinates into one in physical units."""
        out, noise = self._scales()
        K = controller
        return StateSpace(K.A, K.B / noise, K.C * out[:, None], K.D / noise * out[:, None], K.dt)


def is_diagonal(system: StateSpace) -> bool:
    """Tell whether the off-diagonal transfer functions vanish (Markov parameters up to twice the order)."""
    off = ~np.eye(system.n_outputs, system.n_inputs, dtype=bool)
    block, size = system.B, float(np.abs(system.C).max(initial=0) * np.abs(system.B).max(initial=0))
    if np.any(system.D[off]):
        return False
    for _ in range(2 * system.n_states):
        if np.any(np.abs((system.C @ block)[off]) > 1e-12 * size):
            return False
        block = system.A @ block
    return True


def shape_inputs(plant: GeneralizedPlant, weight: StateSpace) -> GeneralizedPlant:
    """Put a filter in front of the disturbances: w = weight * nu."""
    n, k = plant.A.shape[0], weight.n_states
    return GeneralizedPlant(
        np.block([[plant.A, plant.B1 @ weight.C], [np.zeros((k, n)), weight.A]]),
        np.vstack([plant.B1 @ weight.D, weight.B]),
        np.vstack([plant.B2, np.zeros((k, plant.B2.shape[1]))]),
        np.hstack([plant.C1, plant.D11 @ weight.C]),
        np.hstack([plant.C2, plant.D21 @ weight.C]),
        plant.D11 @ weight.D,
        plant.D12,
        plant.D21 @ weight.D,
        plant.D22,
        plant.dt,
    )


def penalise(plant: GeneralizedPlant, penalty: float) -> GeneralizedPlant:
    """Append the weighted control to the performance outputs."""
    n, n_w, n_u, _, _ = plant.sizes
    return GeneralizedPlant(
        plant.A,
        plant.B1,
        plant.B2,
        np.vstack([plant.C1, np.zeros((n_u, n))]),
        plant.C2,
        np.vstack([plant.D11, np.zeros((n_u, n_w))]),
        np.vstack([plant.D12, penalty * np.eye(n_u)]),
        plant.D21,
        plant.D22,
        plant.dt,
    )
