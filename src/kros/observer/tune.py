r"""Population tuning: an observer's gains and model rows, improved on recordings in which the hidden states are known.

An observer of any origin steps by ``x_hat+ = W phi``, ``phi = [theta(x_hat); u; nu; x^c]``, with W the original states' rows of ``[A | B | D^c | C^c]``.
A small change of W changes the estimates by the response of the observer's own error dynamics,

    [d x_hat]+   [ A_s + a delta - D^c C   C^c ] [d x_hat]   [ dW phi ]
    [d x^c  ]  = [ - B^c C                 A^c ] [d x^c  ] + [   0    ],     delta the mean slope of the lifted functions,

(which must not become slower than the recordings can judge), so that one
run of the observer and some Fourier transforms give a Gauss-Newton step for all of W; the filter's own dynamics ``A^c, B^c`` stay.
Where measurements take the place of the measured states' estimates (`remembering_observer`) they go on doing so: W acts on y, and
the rows of the measured states stay.
The criterion is the sum over the hidden states of the logarithm of their mean square error, over all recordings together; a step
counts only if the observer *as it runs* improves by it. Nothing is promised for units that were not recorded: judge it on others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
_ALIKE = 1e-14  # share of a direction below which rounding decides
_MEMORIES = 3  # error dynamics forget within this part of an episode: what is slower, recordings of this length cannot judge


@dataclass(frozen=True, eq=False)
class Tuned:
    """A tuned observer.

    Parameters
    ----------
    observer : Observer
    criterion : tuple of float
        Mean over the hidden states, weighted, of the logarithm of the root mean square error, before tuning and after every step.
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
    importance: Sequence[float] | None = None,
) -> Tuned:
    """Improve an observer with state injection on recordings.

    Parameters
    ----------
    observer : Observer
        Without delays in its lifting; its filter keeps its dynamics.
    states : ndarray, shape (n_samples, batch, n)
        The model may have more states, which are not recorded and tuned as well (`remembering_observer`).
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
    importance : sequence of float, one for every recorded state that is not measured, optional
        Weights of the logarithms in the criterion; all the same by default.

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
    hidden = [i for i in range(states.shape[-1]) if i not in observer.measured]
    if not hidden or len(states) <= 2 * skip:
        raise DataError(
            f"Tuning observer {observer.name}: needs a state that is not measured and more than {2 * skip} samples, found {len(hidden)} and {len(states)}."
        )
    observer = with_delay_line(observer, delays)
    share = np.ones(len(hidden)) if importance is None else np.asarray(importance, dtype=float)
    share = share / share.sum()
    problem = _Tuning(states, inputs, parameters, hidden, skip)
    estimate = problem.run(observer)
    error = problem.errors(estimate)
    if not np.isfinite(error).all():
        raise DataError(f"Tuning observer {observer.name}: it diverges on the recordings; start from one that does not.")
    low, damping, high = _DAMPING
    slowest = max(problem.radius(observer), 1 - _MEMORIES / len(states))
    criterion = [_criterion(error, share)]
    for _ in range(iterations):
        H, g, size, back = problem.normal_equations(observer, estimate, np.sqrt(share) / error)
        while damping <= high:
            step = np.linalg.solve(H + damping * np.eye(len(g)), g)
            trial = problem.changed(observer, (step / size).reshape(-1, back.shape[1]) @ back.T)
            if problem.radius(trial) <= slowest:
                estimate_then = problem.run(trial)
                error_then = problem.errors(estimate_then)
                if _criterion(error_then, share) < criterion[-1]:
                    break
            damping *= 10
        else:
            break
        observer, estimate, error, damping = trial, estimate_then, error_then, max(damping / 10, low)
        criterion.append(_criterion(error, share))
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


def _whitening(rows: Array) -> Array:
    """T of full column rank with ``rows @ T`` orthonormal but for the number of rows."""
    size = np.maximum(np.sqrt(np.mean(rows**2, axis=0)), np.finfo(float).tiny)
    values, vectors = np.linalg.eigh((rows / size).T @ (rows / size) / len(rows))
    kept = values > _ALIKE * values[-1]
    return np.asarray(vectors[:, kept] / np.sqrt(values[kept]) / size[:, None])


def rows_tuned(observer: Observer) -> list[int]:
    """Rows of W that are tuned: all, but for those of measured states where these are not used."""
    kept = set(observer.measured) if observer.replaces else set()
    return [i for i in range(observer.lifting.n_states) if i not in kept]


def _criterion(error: Array, share: Array) -> float:
    return float(share @ np.log(error)) if np.isfinite(error).all() else np.inf


@dataclass(frozen=True, eq=False)
class _Tuning:
    """Recordings to tune on."""

    states: Array
    inputs: Array
    parameters: Mapping[str, npt.ArrayLike] | None
    hidden: list[int]
    skip: int

    def run(self, observer: Observer) -> Array:
        """Estimates of the model's states."""
        return observer.run(self.states[..., list(observer.measured)], self.inputs, self.parameters)

    def errors(self, estimate: Array) -> Array:
        """Root mean square error of every hidden state over all recordings."""
        with np.errstate(over="ignore", invalid="ignore"):
            difference = (self.states - estimate[..., : self.states.shape[-1]])[self.skip :][..., self.hidden]
            return np.asarray(np.sqrt(np.mean(difference**2, axis=(0, 1))))

    def radius(self, observer: Observer) -> float:
        """Spectral radius of the mean error dynamics."""
        F = self._dynamics(observer)
        return float(np.abs(np.linalg.eigvals(F)).max()) if np.isfinite(F).all() else np.inf

    def normal_equations(self, observer: Observer, estimate: Array, weights: Array) -> tuple[Array, Array, Array, Array]:
        """Gauss-Newton matrix and right side for scaled coefficients of ``W T``, their sizes, and T, which makes ``T' phi`` white.

        Regressors are nearly alike, position and target for one: what matters are their differences.
        """
        from scipy.fft import irfft, next_fast_len, rfft

        phi, F = self._regressors(observer, estimate), self._dynamics(observer)
        back = _whitening(phi[self.skip :].reshape(-1, phi.shape[2]))
        phi = phi @ back
        changed, width = rows_tuned(observer), phi.shape[2]
        size = next_fast_len(2 * len(phi), real=True)
        circle = np.exp(2j * np.pi * np.arange(size // 2 + 1) / size)
        outputs = np.eye(len(F))[:, self.hidden].astype(complex)
        response = np.linalg.solve((circle[:, None, None] * np.eye(len(F)) - F).swapaxes(1, 2), outputs)[:, changed]
        rows = np.arange(self.skip, len(phi), _THIN)
        spectra = [rfft(phi[..., j], size, axis=0) for j in range(width)]
        H, g = np.zeros((len(changed) * width,) * 2), np.zeros(len(changed) * width)
        psi = np.empty((len(changed), width, len(rows), phi.shape[1]), np.float32)  # the step needs its direction only
        for out, state in enumerate(self.hidden):
            for row in range(len(changed)):
                for j, spectrum in enumerate(spectra):
                    psi[row, j] = irfft(spectrum * response[:, row, out, None], size, axis=0)[rows] * weights[out]
            X = psi.reshape(len(g), -1)
            missed = ((self.states[rows][..., state] - estimate[rows][..., state]) * weights[out]).ravel()
            H += X @ X.T
            g += X @ missed
        scale = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
        return H / np.outer(scale, scale), g / scale, scale, back

    def changed(self, observer: Observer, dW: Array) -> Observer:
        """The observer with W changed."""
        nl, m, rows, measured = observer.lifting.n_lifted, observer.B.shape[1], rows_tuned(observer), list(observer.measured)
        K = observer.controller
        A, B, D, C = observer.A.copy(), observer.B.copy(), K.D.copy(), K.C.copy()
        q = 0 if observer.replaces else len(measured)
        dA, dB, dD, dC = np.split(dW, np.cumsum([nl, m, q]), axis=1)
        A[rows] += dA
        B[rows] += dB
        D[rows] += dD if q else dA[:, measured]
        C[rows] += dC
        return replace(observer, A=A, B=B, controller=StateSpace(K.A, K.B, C, D, K.dt))

    def _regressors(self, observer: Observer, estimate: Array) -> Array:
        """Phi along a run, shape (n_samples, batch, n_lifted + m + q + n_c)."""
        lifting, K = observer.lifting, observer.controller
        values = {**observer.parameters, **(self.parameters or {})}
        measured = list(observer.measured)
        innovation = self.states[..., measured] - estimate[..., measured]
        if observer.replaces:
            innovation = innovation[..., :0]
        x_c = np.zeros((*estimate.shape[:2], K.n_states))
        for k in range(len(estimate) - 1 if K.n_states else 0):
            x_c[k + 1] = x_c[k] @ K.A.T + innovation[k] @ K.B.T
        return np.concatenate(
            [lifting.lift(estimate, values), lifting.lift_inputs(self.inputs, estimate, values), innovation, x_c], axis=-1
        )

    def _all(self, n: int) -> Array:
        """Recorded states, and zeros for those of the model that are not recorded."""
        return np.concatenate([self.states, np.zeros((*self.states.shape[:2], n - self.states.shape[-1]))], axis=-1)

    def _dynamics(self, observer: Observer) -> Array:
        """Mean error dynamics of observer and filter."""
        lifting, K, n = observer.lifting, observer.controller, observer.lifting.n_states
        A = observer.A[:n, :n]
        if lifting.functions:
            values = {**observer.parameters, **(self.parameters or {})}
            A = A + observer.A[:n, n:] @ lifting.slopes(self._all(lifting.n_states), values).mean(axis=(0, 1))
        C = np.eye(n)[list(observer.measured)]
        return np.block([[A - K.D[:n] @ C, K.C[:n]], [-K.B @ C, K.A]])
