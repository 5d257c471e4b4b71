r"""Population tuning: an observer's gains and model rows, improved on recordings in which the hidden states are known.

An observer steps by ``x_hat+ = W phi``, ``phi = [theta(x_hat); u; nu; x^c]``, with W the original states' rows of ``[A | B | D^c | C^c]``.
A small change of W changes the estimates by the response of the observer's own error dynamics,

    [d x_hat]+   [ A_s + a delta - D^c C   C^c ] [d x_hat]   [ dW phi ]
    [d x^c  ]  = [ - B^c C                 A^c ] [d x^c  ] + [   0    ],     delta the mean slope of the lifted functions,

(which must not become slower than the recordings can judge), so that one run of the observer and its responses give a Gauss-Newton
step for all of W; the filter's own dynamics ``A^c, B^c`` stay.
The criterion is the sum over the hidden states of the logarithm of their mean square error, over all recordings together; a step
counts only if the observer *as it runs* improves by it. Nothing is promised for units that were not recorded: judge it on others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError, DimensionError
from ...core.lti import StateSpace
from ...data import EpisodeBatch
from ...loops import recursion
from ...synthesis.result import Injection
from ..data import ObserverData
from ..residual.one_step import mean_error_dynamics, mean_slopes
from ..simulate import run_observer
from .blocks import blocks_of, moved
from .gauss_newton import SETTLED, Damping, mean_log, scaled, search, whitening

Array = npt.NDArray[np.float64]
O = TypeVar("O", bound=ObserverData)  # noqa: E741
_DAMPING, _LEAST_GAIN = Damping(1e-9, 1e-3, 1e9, 10.0), 1e-3
_SKIP, _SHORT, _THIN = (
    300,
    4,
    4,
)  # samples at the start of an episode, part of a short one, and samples between those that count
_ALIKE = 1e-14


def tune_observer(observer: O, batch: EpisodeBatch, iterations: int = 25) -> tuple[O, tuple[float, ...]]:
    """Improve an observer with state injection on recordings."""
    if observer.injection is not Injection.STATE or observer.lifting.history or observer.internal:
        raise DimensionError(
            f"Tuning observer {observer.name}: it should correct through the state, read no earlier values and have no internal states."
        )
    hidden = [i for i in range(observer.lifting.n_states) if i not in observer.measured]
    if not hidden:
        raise DataError(f"Tuning observer {observer.name}: needs a state that is not measured, found none.")
    problem = _Tuning(observer, batch, hidden)
    start = problem.at(observer)
    if not np.isfinite(start.criterion):
        raise DataError(
            f"Tuning observer {observer.name}: it diverges on the recordings; start from one that does not."
        )
    problem.slowest = max(problem.radius(observer), 1 - SETTLED / len(batch.states))
    found, criterion = search(start, problem.steps, _DAMPING, iterations, _LEAST_GAIN)
    return replace(observer, A=found.observer.A, B=found.observer.B, controller=found.observer.controller), criterion


@dataclass(frozen=True, eq=False)
class _Point:
    """An observer, its estimates along the recordings, and its mean square errors, shape (h,)."""

    observer: ObserverData
    estimate: Array
    errors: Array
    criterion: float


class _Tuning:
    """Recordings to tune on."""

    def __init__(self, observer: ObserverData, batch: EpisodeBatch, hidden: list[int]) -> None:
        self.batch, self.hidden, self.slowest, self.skip = (
            batch,
            hidden,
            np.inf,
            min(_SKIP, len(batch.states) // _SHORT),
        )
        self.values = {**observer.parameters, **observer.own(batch.parameters)}
        self.share = np.full(len(hidden), 1 / len(hidden))
        self.slopes = mean_slopes(observer.lifting, batch.states, batch.inputs, self.values)

    def at(self, observer: ObserverData) -> _Point:
        """Run an observer, unless its error dynamics are too slow."""
        if self.radius(observer) > self.slowest:
            return _Point(observer, np.zeros(0), np.zeros(0), np.inf)
        states = self.batch.states
        estimate = run_observer(observer, self.batch.measurements(observer.measured), self.batch.inputs, self.values)
        with np.errstate(over="ignore", invalid="ignore"):
            errors = np.mean((states - estimate)[self.skip :][..., self.hidden] ** 2, axis=(0, 1))
        return _Point(observer, estimate, errors, mean_log(self.share, errors))

    def radius(self, observer: ObserverData) -> float:
        """Spectral radius of the mean error dynamics."""
        F = self._dynamics(observer)
        return float(np.abs(np.linalg.eigvals(F)).max()) if np.isfinite(F).all() else np.inf

    def steps(self, point: _Point) -> Callable[[float], _Point]:
        """Gauss-Newton steps of ``W T``, where T makes ``T' phi`` white: regressors are nearly alike, what matters are their differences."""
        observer, m, q = point.observer, point.observer.B.shape[1], len(point.observer.measured)
        phi, F, states = self._regressors(point), self._dynamics(observer), observer.lifting.n_states
        rows = phi[self.skip :].reshape(-1, phi.shape[2])
        back = whitening(rows.T @ rows / len(rows), _ALIKE)
        signals = np.ascontiguousarray((phi @ back).transpose(2, 1, 0))
        first, weight = -(-self.skip // _THIN), np.sqrt(self.share / point.errors)
        blocks = blocks_of(F, np.eye(len(F), states), weight[:, None] * np.eye(len(F))[self.hidden])
        X = moved(blocks, signals, _THIN, first).reshape(states * len(signals), -1)
        missed = ((self.batch.states - point.estimate)[first * _THIN :: _THIN][..., self.hidden] * weight).transpose(
            2, 1, 0
        )
        H, g, size = scaled(X @ X.T, X @ missed.ravel())
        splits = np.cumsum([observer.lifting.n_lifted, m, q])

        def trial(damping: float) -> _Point:
            dW = (np.linalg.solve(H + damping * np.eye(len(g)), g) / size).reshape(states, -1) @ back.T
            K, (dA, dB, dD, dC) = (
                observer.controller,
                (np.pad(part, ((0, len(observer.A) - states), (0, 0))) for part in np.split(dW, splits, axis=1)),
            )
            return self.at(
                replace(
                    observer,
                    A=observer.A + dA,
                    B=observer.B + dB,
                    controller=StateSpace(K.A, K.B, K.C + dC, K.D + dD, K.dt),
                )
            )

        return trial

    def _regressors(self, point: _Point) -> Array:
        """Phi along a run, shape (n_samples, batch, n_lifted + m + q + n_c)."""
        lifting, K, measured = point.observer.lifting, point.observer.controller, list(point.observer.measured)
        innovation = self.batch.measurements(measured) - point.estimate[..., measured]
        innovation[~np.isfinite(innovation)] = 0.0  # nothing corrects where nothing arrives
        x_c = recursion(K.A, innovation @ K.B.T, np.zeros((innovation.shape[1], K.n_states)))
        lifted_inputs = lifting.lift_inputs(self.batch.inputs, point.estimate, self.values)
        return np.concatenate([lifting.lift(point.estimate, self.values), lifted_inputs, innovation, x_c], axis=-1)

    def _dynamics(self, observer: ObserverData) -> Array:
        """Mean error dynamics of observer and filter."""
        K, n = observer.controller, observer.lifting.n_states
        A = mean_error_dynamics(observer.A, self.slopes)
        C = np.eye(n)[list(observer.measured)]
        return np.block([[A - K.D[:n] @ C, K.C[:n]], [-K.B @ C, K.A]])
