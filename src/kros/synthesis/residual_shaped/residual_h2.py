r"""The residual-shaped observer: the Kalman predictor for disturbances with the spectrum that was measured.

The error of an observer on any unit is driven by the one-step residual omega of the nominal model, which does not
depend on the observer and can be measured on every unit. With a shaping filter ``omega = C_f zeta + D_f w``, ``zeta+ =
A_f zeta + B_f w`` of the population's mean spectrum,

    [ e    ]+   [ A   C_f ] [ e    ]   [ D_f ]       [ I ]
    [ zeta ]  = [ 0   A_f ] [ zeta ] + [ B_f ] w  -  [ 0 ] y^c,      nu = C e + v,

the error of least variance is left by the Kalman predictor's gains ``L = [L_e; L_zeta]``, which is a correction through
the state of the order of the filter: ``zeta_hat+ = A_f zeta_hat + L_zeta nu``, ``y^c = C_f zeta_hat + L_e nu``. For the
mean spectrum it minimises the mean square error over the units.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from ...core.arrays import AnyArray, Array, Index, frozen
from ...core.errors import SynthesisError
from ...core.lti import StateSpace, gain
from ...core.norms import gramian, gramian_root, h2_norm
from ...core.rounding import ROUNDING, TINY
from ..result import Injection, Status, Synthesis, enclosed
from ..riccati.equations import balancing
from ..riccati.kalman import kalman, predictor_bound
from .shaping_filter import Basis, circle_weights, shaping_filter


@frozen
class ResidualProblem:
    """Error dynamics, residuals of a population, and measurement noise."""

    A: Array  # (n, n), error dynamics of the original states
    C: Array  # (q, n), selects the measured states
    spectra: AnyArray  # (unit, f, n, n), complex: cross spectral density of every unit's one-step residual
    noise: Array  # (q,), standard deviation of the measurement noise
    scale: Array  # (n,), range of every state; norms are of errors in these units
    dt: float  # s

    def __post_init__(self) -> None:
        for name in ("A", "C", "noise", "scale"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))

    def scaled(self, basis: Basis) -> _Scaled:
        """Return the problem in scaled coordinates, for a basis of the shaping filter."""
        x = self.scale
        return _Scaled(self.A / x[:, None] * x, self.C * x, self.noise, self.spectra / np.outer(x, x), basis, self.dt)


def residual_h2(
    problem: ResidualProblem,
    basis: Basis | None = None,
    tolerance_percent: float = 1.0,
    n_lifted: int | None = None,
    max_order: int | None = None,
) -> Synthesis:
    """Return the correction that is optimal for residuals; reducing its order costs each hidden state the tolerance."""
    start = time.perf_counter()
    shaped = problem.scaled(basis or Basis())
    full = shaped.filter()
    K = shaped.correction(full)
    if not np.isfinite(shaped.norm(full, K)):
        raise SynthesisError(
            "Residual-shaped observer: its error is not bounded; check the model and what is measured."
        )
    K = shaped.reduced(full, K, tolerance_percent, full.n_states if max_order is None else max_order)
    norm = shaped.norm(full, K)
    note = f"mean of {len(shaped.spectra)} units, {shaped.basis.delays} delays, lags {shaped.basis.poles}"
    note += f", order {full.n_states} reduced to {K.n_states}" if K.n_states < full.n_states else ""
    lower, gap, notes = enclosed(norm, shaped.lower_bound(full))
    n = len(problem.A)
    to_lifted = np.vstack([np.diag(problem.scale), np.zeros(((n_lifted or n) - n, n))])
    return Synthesis(
        method="residual_h2",
        controller=gain(to_lifted, problem.dt) @ K,
        status=Status.OPTIMAL if K.n_states == full.n_states else Status.CERTIFIED,
        injection=Injection.STATE,
        h2_norm=norm,
        lower_bound=lower,
        gap_percent=gap,
        spectral_radius=shaped.error_system(K).largest_pole(),
        solve_s=time.perf_counter() - start,
        solver="riccati",
        notes=(note, *notes),
    )


def promised_errors(problem: ResidualProblem) -> Array:
    """Return the RMS error of every state, a share of its largest value, on the spectra as measured."""
    shaped = problem.scaled(Basis())
    try:
        K = shaped.correction(shaped.filter())
    except SynthesisError:
        return np.full(len(shaped.A), np.inf)
    return np.sqrt(shaped.unit_errors(K).mean(axis=0))


@frozen
class _Scaled:
    """The problem in scaled coordinates."""

    A: Array
    C: Array
    noise: Array
    spectra: AnyArray
    basis: Basis
    dt: float

    def filter(self) -> StateSpace:
        """Shaping filter of the units' mean spectrum."""
        return shaping_filter(self.spectra.mean(axis=0), self.basis, self.dt)

    def shaped(self, shaping: StateSpace) -> tuple[Array, Array, Array]:
        """Plant behind its shaping filter: dynamics, input of the white noise, measurement."""
        A = np.block([[self.A, shaping.C], [np.zeros((shaping.n_states, len(self.A))), shaping.A]])
        return A, np.vstack([shaping.D, shaping.B]), np.hstack([self.C, np.zeros((len(self.C), shaping.n_states))])

    def lower_bound(self, shaping: StateSpace) -> float:
        """Root mean square of the scaled error that no correction falls below."""
        A, G, C = self.shaped(shaping)
        (n, k), q = G.shape, len(C)
        B, D = np.hstack([G, np.zeros((n, q))]), np.hstack([np.zeros((q, k)), np.diag(self.noise)])
        return float(np.sqrt(predictor_bound(A, B, C, D, np.eye(len(self.A), n))))

    def correction(self, shaping: StateSpace) -> StateSpace:
        """Kalman gains of plant and shaping filter as a correction filter."""
        n = len(self.A)
        A, G, C = self.shaped(shaping)
        L = kalman(A, C, G @ G.T, np.diag(self.noise**2), self.dt).controller.D
        return StateSpace(shaping.A, L[n:], shaping.C, L[:n], self.dt)

    def error_system(self, K: StateSpace) -> StateSpace:
        """From (omega, white noise of unit variance) to the error e."""
        n, root = len(self.A), np.diag(self.noise)
        A = np.block([[self.A - K.D @ self.C, -K.C], [K.B @ self.C, K.A]])
        B = np.block([[np.eye(n), -K.D @ root], [np.zeros((K.n_states, n)), K.B @ root]])
        return StateSpace(A, B, np.eye(n, len(A)), np.zeros((n, B.shape[1])), self.dt)

    def loop(self, shaping: StateSpace, K: StateSpace) -> StateSpace:
        """From white noise of unit variance to the error, omega made by a shaping filter."""
        error, n = self.error_system(K), len(self.A)
        drive, rest = error.B[:, :n], error.B[:, n:]
        A = np.block([[error.A, drive @ shaping.C], [np.zeros((shaping.n_states, error.n_states)), shaping.A]])
        B = np.block([[drive @ shaping.D, rest], [shaping.B, np.zeros((shaping.n_states, rest.shape[1]))]])
        return StateSpace(
            A, B, np.hstack([error.C, np.zeros((n, shaping.n_states))]), np.zeros((n, B.shape[1])), self.dt
        )

    @property
    def hidden(self) -> Index:
        """States that are not measured; all where none is hidden."""
        measured = np.any(self.C, axis=0)
        return np.flatnonzero(~measured) if not measured.all() else np.arange(len(self.A))

    def deviations(self, shaping: StateSpace, K: StateSpace) -> Array:
        """Root mean square of every state's scaled error, (n,), infinite where the error dynamics are unstable."""
        loop = self.loop(shaping, K)
        if not loop.is_stable():
            return np.full(len(self.A), np.inf)
        return np.sqrt(np.maximum(np.diag(loop.C @ gramian(loop.A, loop.B, self.dt) @ loop.C.T), TINY))

    def norm(self, shaping: StateSpace, K: StateSpace) -> float:
        """Root mean square of the scaled error."""
        return h2_norm(self.loop(shaping, K))

    def unit_errors(self, K: StateSpace) -> Array:
        """Variance of every state's error on every unit, from the units' own spectra; shape (unit, n)."""
        f, n = self.spectra.shape[1], len(self.A)
        response = self.error_system(K).frequency_response(np.linspace(0, 0.5 / self.dt, f))
        weight = circle_weights(f)
        drive, rest = response[..., :n], response[..., n:]
        driven = np.einsum("f,fia,ufab,fib->ui", weight, drive, self.spectra, drive.conj(), optimize=True).real
        return driven + np.einsum("f,fia->i", weight, np.abs(rest) ** 2)

    def reduced(self, shaping: StateSpace, K: StateSpace, tolerance_percent: float, most: int) -> StateSpace:
        """Correction filter of the lowest order within the tolerance, by bisection over balanced truncations."""
        if not shaping.n_states or (tolerance_percent <= 0 and most >= shaping.n_states):
            return K
        best, loop = self.deviations(shaping, K), self.loop(shaping, K)
        seen = gramian_root(loop.A.T, (loop.C / best[:, None]).T)[-shaping.n_states :]
        left, right, values = balancing(gramian_root(shaping.A, shaping.B), seen, ROUNDING)
        allowed = (1 + tolerance_percent / 100) * best[self.hidden]

        def of_order(k: int) -> StateSpace:
            L, R = left[:k], right[:, :k]
            return self.correction(replace(shaping, A=L @ shaping.A @ R, B=L @ shaping.B, C=shaping.C @ R))

        low, high = -1, min(len(values), most) + 1
        while high - low > 1:
            k = (low + high) // 2
            trial = of_order(k)
            if np.all(self.deviations(shaping, trial)[self.hidden] <= allowed):
                K, high = trial, k
            else:
                low = k
        return K if K.n_states <= most else of_order(min(len(values), most))
