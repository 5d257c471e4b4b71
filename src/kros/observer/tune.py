r"""Population tuning: an observer's gains and model rows, improved on recordings in which the hidden states are known.

An observer of any origin steps by ``x_hat+ = W phi``, ``phi = [theta(x_hat); u; nu; x^c]``, with W the original states' rows of ``[A | B | D^c | C^c]``.
A small change of W changes the estimates by the response of the observer's own error dynamics,

    [d x_hat]+   [ A_s + a delta - D^c C   C^c ] [d x_hat]   [ dW phi ]
    [d x^c  ]  = [ - B^c C                 A^c ] [d x^c  ] + [   0    ],     delta the mean slope of the lifted functions,

(which must not become slower than the recordings can judge), so that one
run of the observer and some Fourier transforms give a Gauss-Newton step for all of W; the filter's own dynamics ``A^c, B^c`` stay.
The criterion is the sum over the hidden states of the logarithm of their mean square error, over all recordings together; a step
counts only if the observer *as it runs* improves by it. Nothing is promised for units that were not recorded: judge it on others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, DimensionError
from ..core.lti import StateSpace
from ..synthesis.result import Injection
from .observer import Observer

Array = npt.NDArray[np.float64]
_DAMPING = (1e-9, 1e-3, 1e9)
_THIN = 4
_MEMORIES = 5  # error dynamics forget within this part of an episode: what is slower, recordings of this length cannot judge


@dataclass(frozen=True, eq=False)
class Tuned:
    """A tuned observer.

    Parameters
    ----------
    observer : Observer
    criterion : tuple of float
        Mean over the hidden states of the logarithm of the root mean square error, before tuning and after every step.
    """

    observer: Observer
    criterion: tuple[float, ...]


def tune_observer(
    observer: Observer,
    states: Array,
    inputs: Array,
    parameters: Mapping[str, npt.ArrayLike] | None = None,
    delays: int = 0,
    iterations: int = 25,
    skip: int = 300,
    least_gain: float = 1e-3,
) -> Tuned:
    """Improve an observer with state injection on recordings.

    Parameters
    ----------
    observer : Observer
        Without delays in its lifting; its filter keeps its dynamics.
    states : ndarray, shape (n_samples, batch, n)
    inputs : ndarray, shape (n_samples, batch, m)
    parameters : mapping of str to array_like, shape (batch,)
        Lifting parameters of the machine behind each episode.
    delays : int
        So many of the last innovations are added to the filter's states first, without weight, for the steps to use.
    iterations : int
        Most steps.
    skip : int
        Samples at the start of every episode that do not count.
    least_gain : float
        Decrease of the criterion below which the search ends.

    Returns
    -------
    Tuned

    Raises
    ------
    DimensionError
        When the observer corrects through the input, or its lifting reads earlier values.
    DataError
        When every state is measured, recordings are too short, or the observer diverges on them.
    """
    if observer.injection is not Injection.STATE or observer.lifting.history:
        raise DimensionError(f"Tuning observer {observer.name}: it should correct through the state and read no earlier values.")
    hidden = [i for i in range(observer.lifting.n_states) if i not in observer.measured]
    if not hidden or len(states) <= 2 * skip:
        raise DataError(
            f"Tuning observer {observer.name}: needs a state that is not measured and more than {2 * skip} samples, found {len(hidden)} and {len(states)}."
        )
    observer = with_delay_line(observer, delays)
    problem = _Tuning(states, inputs, parameters, hidden, skip)
    estimate = problem.run(observer)
    error = problem.errors(estimate)
    if not np.isfinite(error).all():
        raise DataError(f"Tuning observer {observer.name}: it diverges on the recordings; start from one that does not.")
    low, damping, high = _DAMPING
    slowest = max(problem.radius(observer), 1 - _MEMORIES / len(states))
    criterion = [_criterion(error)]
    for _ in range(iterations):
        H, g, size = problem.normal_equations(observer, estimate, 1 / error)
        while damping <= high:
            step = np.linalg.solve(H + damping * np.eye(len(g)), g) / size
            trial = problem.changed(observer, step)
            if problem.radius(trial) <= slowest:
                estimate_then = problem.run(trial)
                error_then = problem.errors(estimate_then)
                if _criterion(error_then) < criterion[-1]:
                    break
            damping *= 10
        else:
            break
        observer, estimate, error, damping = trial, estimate_then, error_then, max(damping / 10, low)
        criterion.append(_criterion(error))
        if criterion[-2] - criterion[-1] < least_gain:
            break
    return Tuned(observer, tuple(criterion))


def with_delay_line(observer: Observer, delays: int) -> Observer:
    """Return the same observer whose filter also keeps the last innovations, unused so far; `q * delays` states more."""
    K, q = observer.controller, len(observer.measured)
    shift = np.kron(np.eye(delays, k=-1), np.eye(q))
    A = np.block([[K.A, np.zeros((K.n_states, len(shift)))], [np.zeros((len(shift), K.n_states)), shift]])
    B = np.vstack([K.B, np.eye(len(shift), q)])
    C = np.hstack([K.C, np.zeros((K.n_outputs, len(shift)))])
    return replace(observer, controller=StateSpace(A, B, C, K.D, K.dt))


def _criterion(error: Array) -> float:
    return float(np.mean(np.log(error))) if np.isfinite(error).all() else np.inf


@dataclass(frozen=True, eq=False)
class _Tuning:
    """Recordings to tune on."""

    states: Array
    inputs: Array
    parameters: Mapping[str, npt.ArrayLike] | None
    hidden: list[int]
    skip: int

    def run(self, observer: Observer) -> Array:
        """Estimates of the original states."""
        return observer.run(self.states[..., list(observer.measured)], self.inputs, self.parameters)

    def errors(self, estimate: Array) -> Array:
        """Root mean square error of every hidden state over all recordings."""
        with np.errstate(over="ignore", invalid="ignore"):
            difference = (self.states - estimate)[self.skip :][..., self.hidden]
            return np.asarray(np.sqrt(np.mean(difference**2, axis=(0, 1))))

    def radius(self, observer: Observer) -> float:
        """Spectral radius of the mean error dynamics."""
        F = self._dynamics(observer)
        return float(np.abs(np.linalg.eigvals(F)).max()) if np.isfinite(F).all() else np.inf

    def normal_equations(self, observer: Observer, estimate: Array, weights: Array) -> tuple[Array, Array, Array]:
        """Gauss-Newton matrix and right side in scaled coefficients of W, and the coefficients' sizes."""
        from scipy.fft import irfft, next_fast_len, rfft

        phi, F = self._regressors(observer, estimate), self._dynamics(observer)
        n = observer.lifting.n_states
        size = next_fast_len(2 * len(phi), real=True)
        circle = np.exp(2j * np.pi * np.arange(size // 2 + 1) / size)
        response = np.linalg.solve(circle[:, None, None] * np.eye(len(F)) - F, np.eye(len(F), n).astype(complex))[:, self.hidden]
        rows = np.arange(self.skip, len(phi), _THIN)
        psi = np.empty((len(rows), phi.shape[1], len(self.hidden), n, phi.shape[2]))
        for j in range(phi.shape[2]):
            spectrum = rfft(phi[..., j], size, axis=0)
            for out in range(len(self.hidden)):
                for row in range(n):
                    psi[..., out, row, j] = irfft(spectrum * response[:, out, row, None], size, axis=0)[rows] * weights[out]
        X = psi.reshape(-1, n * phi.shape[2])
        missed = ((self.states - estimate)[rows][..., self.hidden] * weights).reshape(-1)
        H, g = X.T @ X, X.T @ missed
        scale = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
        return H / np.outer(scale, scale), g / scale, scale

    def changed(self, observer: Observer, step: Array) -> Observer:
        """The observer with W changed."""
        n, nl, m, q = observer.lifting.n_states, observer.lifting.n_lifted, observer.B.shape[1], len(observer.measured)
        K, dW = observer.controller, step.reshape(n, -1)
        A, B, D, C = observer.A.copy(), observer.B.copy(), K.D.copy(), K.C.copy()
        for matrix, change in zip((A, B, D, C), np.split(dW, np.cumsum([nl, m, q]), axis=1), strict=True):
            matrix[:n] += change
        return replace(observer, A=A, B=B, controller=StateSpace(K.A, K.B, C, D, K.dt))

    def _regressors(self, observer: Observer, estimate: Array) -> Array:
        """Phi along a run, shape (n_samples, batch, n_lifted + m + q + n_c)."""
        lifting, K = observer.lifting, observer.controller
        values = {**observer.parameters, **(self.parameters or {})}
        innovation = (self.states - estimate)[..., list(observer.measured)]
        x_c = np.zeros((*estimate.shape[:2], K.n_states))
        for k in range(len(estimate) - 1):
            x_c[k + 1] = x_c[k] @ K.A.T + innovation[k] @ K.B.T
        return np.concatenate(
            [lifting.lift(estimate, values), lifting.lift_inputs(self.inputs, estimate, values), innovation, x_c], axis=-1
        )

    def _dynamics(self, observer: Observer) -> Array:
        """Mean error dynamics of observer and filter."""
        lifting, K, n = observer.lifting, observer.controller, observer.lifting.n_states
        A = observer.A[:n, :n]
        if lifting.functions:
            values = {**observer.parameters, **(self.parameters or {})}
            A = A + observer.A[:n, n:] @ lifting.slopes(self.states, values).mean(axis=(0, 1))
        C = np.eye(n)[list(observer.measured)]
        return np.block([[A - K.D[:n] @ C, K.C[:n]], [-K.B @ C, K.A]])
