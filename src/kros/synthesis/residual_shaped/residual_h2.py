r"""The residual-shaped observer: the Kalman predictor for disturbances with the spectrum that was measured.

The error of an observer on any unit is driven by the one-step residual omega of the nominal model, which does not
depend on the observer and can be measured on every unit. With a shaping filter ``omega = C_f zeta + D_f w``, ``zeta+ =
A_f zeta + B_f w`` of the population's mean spectrum,

    [ e    ]+   [ A   C_f ] [ e    ]   [ D_f ]       [ I ]
    [ zeta ]  = [ 0   A_f ] [ zeta ] + [ B_f ] w  -  [ 0 ] y^c,      nu = C e + v,

the error of least variance is left by the Kalman predictor's gains ``L = [L_e; L_zeta]``, which is a correction through
the state of the order of the filter: ``zeta_hat+ = A_f zeta_hat + L_zeta nu``, ``y^c = C_f zeta_hat + L_e nu``. For the
mean spectrum it minimises the mean square error over the units.

Shaping filters: stable models of low order whose output has a given spectrum.

The signal omega passes a basis of delays and first-order lags, ``z+ = A_z z + B_z omega``, with covariance

.. math:: G = \frac{1}{2\pi} \int Z S Z^H \, d\theta, \qquad Z = (e^{j\theta} I - A_z)^{-1} B_z

and is predicted from it by least squares, ``omega = Theta z + Sigma^(1/2) w``: with delays alone this is the vector
autoregression of Yule and Walker, and lags lengthen its memory without many states. The model is ``z+ = (A_z + B_z
Theta) z + B_z Sigma^(1/2) w``. Because the prediction error is orthogonal to z, ``G = (A_z + B_z Theta) G (...)' + B_z
Sigma B_z'`` holds exactly, on a grid of frequencies too, so the filter is *always stable* and reproduces G. Everything
is linear in the spectrum until the least squares: spectra of units may be weighted.

References
----------
C. I. Byrnes, T. T. Georgiou and A. Lindquist, "A new approach to spectral estimation: a tunable high-resolution
spectral estimator", IEEE Transactions on Signal Processing 48 (2000) 3189-3205.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import field, replace
from functools import cached_property

import numpy as np

from ...core import ITERATED, ROUNDING, TINY, AnyArray, Flags, StateSpace, SynthesisError, block_diagonal, frozen, gain
from ...core.norms import gramian, gramian_root
from ..result import Injection, Status, Synthesis, enclosed
from ..riccati.h2 import balancing, kalman, predictor_bound

_FLOOR = ROUNDING  # white noise of every channel, relative to the largest, which keeps the Gramian regular


@frozen
class Basis:
    """Delays and first-order lags of every channel."""

    delays: int = 8
    # Of the lags, inside the unit circle, each one once: disturbances that last up to 300 samples
    poles: tuple[float, ...] = (0.9, 0.97, 0.99, 0.997)

    @cached_property
    def scalar(self) -> StateSpace:
        """The basis of one channel; its outputs are the states."""
        from scipy.linalg import block_diag

        poles = np.array(self.poles)
        b = np.concatenate([np.eye(self.delays, 1)[:, 0], np.sqrt(1 - poles**2)])[:, None]
        A = block_diag(np.eye(self.delays, k=-1), np.diag(poles))
        return StateSpace(A, b, np.eye(len(A)), np.zeros_like(b), 1.0)


def circle_weights(f: int) -> AnyArray:
    """Return weights of the mean over the unit circle, for f equal steps from zero to Nyquist; they sum to one."""
    weight = np.full(f, 1.0 / (f - 1))
    weight[[0, -1]] /= 2
    return weight


def shaping_filter(spectrum: AnyArray, basis: Basis, dt: float) -> StateSpace:
    """Fit a shaping filter to a spectrum."""
    f, n = spectrum.shape[:2]
    weight = circle_weights(f)
    R = np.tensordot(weight, spectrum, 1).real
    largest = float(np.max(np.diag(R), initial=0.0))
    if not (np.isfinite(R).all() and largest > 0):
        raise SynthesisError("Shaping filter: the residual is zero or not finite; correct nothing (open loop).")
    floor = _FLOOR * largest * np.eye(n)
    R, spectrum = R + floor, spectrum + floor
    scalar = basis.scalar
    response, k = scalar.frequency_response(np.linspace(0, 0.5, f))[..., 0], scalar.n_states
    blocks = np.einsum("f,fa,fb,fij->aibj", weight, response, response.conj(), spectrum, optimize=True).real
    G = blocks.reshape(k * n, k * n)
    cross = np.einsum("f,fb,fij->ibj", weight, response.conj(), spectrum, optimize=True).real.reshape(n, k * n)
    Theta = np.linalg.solve(G, cross.T).T
    innovation = R - Theta @ cross.T
    values, vectors = np.linalg.eigh((innovation + innovation.T) / 2)
    if values.max() <= ITERATED * largest:
        error = f"{np.sqrt(max(values.max(), 0) / largest):.1g} of its size"
        problem = f"the residual can be predicted to {error}, it is constant or a few tones"
        raise SynthesisError(f"Shaping filter: {problem}; record longer or richer episodes.")
    root = vectors * np.sqrt(np.maximum(values, 0))
    A, B = (np.kron(M, np.eye(n)) for M in (scalar.A, scalar.B))  # the channels of one delay or lag side by side
    return StateSpace(A + B @ Theta, B @ root, Theta, root, dt)


@frozen
class ResidualProblem:
    """Error dynamics, residuals of a population, and measurement noise."""

    A: AnyArray  # (n, n), error dynamics of the original states
    C: AnyArray  # (q, n), selects the measured states
    spectra: AnyArray  # (unit, f, n, n), complex: cross spectral density of every unit's one-step residual
    noise: AnyArray  # (q,), standard deviation of the measurement noise
    scale: AnyArray  # (n,), range of every state; norms are of errors in these units
    dt: float  # s
    basis: Basis = field(default_factory=Basis)  # of the shaping filter

    @cached_property
    def plant(self) -> StateSpace:
        """From the residual omega to the measurements, scaled; the states are the errors."""
        x, n = self.scale, len(self.A)
        return StateSpace(self.A / x[:, None] * x, np.eye(n), self.C * x, np.zeros((len(self.C), n)), self.dt)

    @cached_property
    def scaled_spectra(self) -> AnyArray:
        """Spectra in scaled coordinates."""
        return self.spectra / np.outer(self.scale, self.scale)

    def filter(self) -> StateSpace:
        """Shaping filter of the units' mean spectrum."""
        return shaping_filter(self.scaled_spectra.mean(axis=0), self.basis, self.plant.dt)

    def lower_bound(self, shaping: StateSpace) -> float:
        """Root mean square of the scaled error that no correction falls below."""
        whole, q = self.plant @ shaping, len(self.noise)
        B, D = np.hstack([whole.B, np.zeros((whole.n_states, q))]), np.hstack([whole.D, np.diag(self.noise)])
        Z = np.eye(self.plant.n_states, whole.n_states)
        return float(np.sqrt(predictor_bound(whole.A, B, whole.C, D, Z)))

    def correction(self, shaping: StateSpace) -> StateSpace:
        """Kalman gains of plant and shaping filter as a correction filter."""
        n, whole = self.plant.n_states, self.plant @ shaping
        L = kalman(whole.A, whole.C, whole.B @ whole.B.T, np.diag(self.noise**2), whole.dt).controller.D
        return StateSpace(shaping.A, L[n:], shaping.C, L[:n], shaping.dt)

    def error_system(self, K: StateSpace) -> StateSpace:
        """From (omega, white noise of unit variance) to the error e."""
        n, C, root = self.plant.n_states, self.plant.C, np.diag(self.noise)
        A = np.block([[self.plant.A - K.D @ C, -K.C], [K.B @ C, K.A]])
        B = np.block([[np.eye(n), -K.D @ root], [np.zeros((K.n_states, n)), K.B @ root]])
        return StateSpace(A, B, np.eye(n, len(A)), np.zeros((n, B.shape[1])), K.dt)

    def loop(self, shaping: StateSpace, K: StateSpace) -> StateSpace:
        """From white noise of unit variance to the error, omega made by a shaping filter."""
        return self.error_system(K) @ block_diagonal([shaping, gain(np.eye(len(self.noise)), K.dt)])

    @property
    def hidden(self) -> Flags:
        """States that are not measured; all where none is hidden."""
        measured = np.any(self.plant.C, axis=0)
        return ~measured | measured.all()

    def deviations(self, shaping: StateSpace, K: StateSpace) -> AnyArray:
        """Root mean square of every state's scaled error, (n,)."""
        loop = self.loop(shaping, K)
        return np.sqrt(np.maximum(np.diag(loop.C @ gramian(loop.A, loop.B, loop.dt) @ loop.C.T), TINY))

    def reduced(self, shaping: StateSpace, K: StateSpace, tolerance_percent: float, most: int) -> StateSpace:
        """Correction filter of the lowest order within the tolerance, by bisection over balanced truncations."""
        best, loop = self.deviations(shaping, K), self.loop(shaping, K)
        seen = gramian_root(loop.A.T, (loop.C / best[:, None]).T)[-shaping.n_states :]
        left, right, values = balancing(gramian_root(shaping.A, shaping.B), seen, ROUNDING)
        allowed = (1 + tolerance_percent / 100) * best[self.hidden]

        def of_order(k: int) -> StateSpace:
            L, R = left[:k], right[:, :k]
            return self.correction(replace(shaping, A=L @ shaping.A @ R, B=L @ shaping.B, C=shaping.C @ R))

        def enough(k: int) -> bool:
            return bool(np.all(self.deviations(shaping, of_order(k))[self.hidden] <= allowed))

        most = min(len(values), most)
        return of_order(min(bisect_left(range(most + 1), True, key=enough), most))


def residual_h2(
    problem: ResidualProblem,
    tolerance_percent: float = 1.0,
    n_lifted: int | None = None,
    order: int | None = None,
) -> Synthesis:
    """Return the correction that is optimal for residuals; reducing its order costs each hidden state the tolerance."""
    full = problem.filter()
    most = full.n_states if order is None else order
    K = problem.reduced(full, problem.correction(full), tolerance_percent, most)
    norm = float(np.linalg.norm(problem.deviations(full, K)))
    note = f"mean of {len(problem.spectra)} units, {problem.basis.delays} delays, lags {problem.basis.poles}"
    note += f", order {full.n_states} reduced to {K.n_states}" if K.n_states < full.n_states else ""
    lower, gap, notes = enclosed(norm, problem.lower_bound(full))
    n = len(problem.A)
    to_lifted = np.eye(n_lifted or n, n) * problem.scale
    return Synthesis(
        method="residual_h2",
        controller=gain(to_lifted, problem.dt) @ K,
        status=Status.OPTIMAL if K.n_states == full.n_states else Status.CERTIFIED,
        injection=Injection.STATE,
        h2_norm=norm,
        lower_bound=lower,
        gap_percent=gap,
        spectral_radius=problem.error_system(K).largest_pole(),
        notes=(note, *notes),
    )


def promised_errors(problem: ResidualProblem) -> AnyArray:
    """Return the RMS error of every state, a share of its largest value, on the spectra as measured."""
    try:
        K = problem.correction(problem.filter())
    except SynthesisError:
        return np.full(len(problem.A), np.inf)
    f, n = problem.spectra.shape[1:3]
    response = problem.error_system(K).frequency_response(np.linspace(0, 0.5 / K.dt, f))
    weight, drive, rest = circle_weights(f), response[..., :n], response[..., n:]
    mean = problem.scaled_spectra.mean(axis=0)
    driven = np.einsum("f,fia,fab,fib->i", weight, drive, mean, drive.conj(), optimize=True).real
    return np.sqrt(driven + np.einsum("f,fia->i", weight, np.abs(rest) ** 2))
