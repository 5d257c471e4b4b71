r"""The extended Kalman filter of the re-lifted model: its gain follows the slopes at the estimate.

The model of the original states is ``x+ = f(x, u) = A_s theta(x) + B_s u``, the first n rows of the lifted model, with
white noise Q on x+ and R on y. At every sample

    S = C P C' + R,   L = P C' S^-1,   x^ = x_hat + L (y - C x_hat),   P^ = P - L C P
    x_hat+ = f(x^, u),   F = df/dx (x^),   P+ = F P^ F' + Q

Slopes by earlier values and of input functions count as noise. With a linear model this is the Kalman filter with its
start.

References
----------
B. D. O. Anderson and J. B. Moore, Optimal Filtering, Prentice-Hall 1979, section 8.2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError
from ...lifting import Lifting
from ..screen import require_samples

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ExtendedKalman:
    """Extended Kalman filter; measured states start with the measurement's noise."""

    lifting: Lifting
    A: Array  # (n_lifted, n_lifted)
    B: Array  # (n_lifted, m), with input functions
    measured: tuple[int, ...]
    inputs: tuple[str, ...]
    Q: Array  # (n, n), process noise of the original states; or (k, n, n) for k filters at once
    R: Array  # (q, q), measurement noise
    P0: Array  # (n, n), of the first estimate
    parameters: Mapping[str, float] = field(default_factory=dict)
    delay: int = 0  # samples by which measurements are late: it corrects as of then, and predicts forward

    def run(
        self,
        y: Array,
        u: Array,
        parameters: Mapping[str, npt.ArrayLike] | None = None,
        starts: npt.NDArray[np.bool_] | None = None,
    ) -> Array:
        """Predict a batch from y (n_samples, batch, q), NaN where missing, and u; machines start again at `starts`."""
        return self.run_all(y, u, parameters, starts)[0]

    def run_all(
        self,
        y: Array,
        u: Array,
        parameters: Mapping[str, npt.ArrayLike] | None = None,
        starts: npt.NDArray[np.bool_] | None = None,
    ) -> Array:
        """Run all filters of a stack Q (k, n, n) side by side, shape (k, n_samples, batch, n)."""
        require_samples("the extended Kalman filter", len(self.measured), self.inputs, y, u)
        starts = np.zeros(y.shape[:2], dtype=bool) if starts is None else starts
        if self.delay:
            return self._late(y, u, parameters, starts)
        lifting, n, C = self.lifting, self.lifting.n_states, list(self.measured)
        Q = self.Q.reshape(-1, 1, n, n)
        k, (n_samples, batch) = len(Q), y.shape[:2]
        values = {
            name: np.broadcast_to(np.asarray(v, dtype=float), (batch,))
            for name, v in {**self.parameters, **(parameters or {})}.items()
        }
        x, P = np.zeros((k, batch, n)), np.zeros((k, batch, n, n))
        earlier = np.zeros((k, batch, len(lifting.window.earlier)))
        estimates = np.empty((n_samples, k, batch, n))
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for sample in range(n_samples):
                begins, held = starts[sample] | (sample == 0), np.broadcast_to(u[sample], (k, *u[sample].shape))
                estimates[sample] = x
                if begins.any():
                    x[:, begins], P[:, begins] = 0.0, self.P0
                    x[..., C] = np.where(begins[:, None], np.where(np.isfinite(y[sample]), y[sample], 0.0), x[..., C])
                if sample == 0:
                    estimates[0] = x
                x, P = self._corrected(x, P, y[sample])
                earlier = np.where(begins[:, None], lifting.window.hold(x, held), earlier) if begins.any() else earlier
                window = np.concatenate([x, earlier], axis=-1)
                F = self.A[:n, :n] + self.A[:n, n:] @ lifting.slopes(window, values)[..., :n]
                x = self._ahead(window, held, values)
                P = F @ P @ np.swapaxes(F, -1, -2) + Q
                P = (P + P.swapaxes(-1, -2)) / 2
                earlier = lifting.window.advance(window, held)
        return np.moveaxis(estimates, 0, 1)

    def _ahead(self, window: Array, u: Array, values: Mapping[str, npt.ArrayLike]) -> Array:
        """Return the next states by the model."""
        n, lifting = self.lifting.n_states, self.lifting
        return np.asarray(
            lifting.lift(window, values) @ self.A[:n].T + lifting.lift_inputs(u, window, values) @ self.B[:n].T
        )

    def _corrected(self, x: Array, P: Array, y: Array) -> tuple[Array, Array]:
        """Return estimate and covariance with a measurement; one of which a channel is missing is left out whole."""
        PC, nu = P[..., list(self.measured)], y - x[..., list(self.measured)]
        L, lost = _divided(PC, PC[..., list(self.measured), :] + self.R), np.atleast_1d(~np.isfinite(y).all(axis=-1))
        L, nu = np.where(lost[:, None, None], 0.0, L), np.where(lost[:, None], 0.0, nu)
        return x + (L @ nu[..., None])[..., 0], P - L @ PC.swapaxes(-1, -2)

    def _late(
        self, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None, starts: npt.NDArray[np.bool_]
    ) -> Array:
        """Run on what was measured, and predict each estimate to the row in which it is there."""
        d, values = min(self.delay, len(y) - 1), {**self.parameters, **(parameters or {})}
        if self.lifting.history:
            raise DimensionError(
                f"Extended Kalman filter: a delay of {d} samples needs a lifting of present values, found "
                f"{self.lifting.functions}."
            )
        x = replace(self, delay=0).run_all(y[d:], u[: len(u) - d], parameters, starts[d:])
        late = np.empty((len(x), len(y), *x.shape[2:]))
        for step in range(d):
            late[:, step] = x[:, 0]  # nothing arrived but where to start
            x = self._ahead(x, np.broadcast_to(u[step : len(u) - d + step], (*x.shape[:-1], u.shape[-1])), values)
        late[:, d:] = x
        return late


def start_covariance(scale: Array, R: Array, measured: Sequence[int]) -> Array:
    """Return the covariance of the first estimate: a state anywhere in its range, a measured one with noise."""
    P0 = np.diag(scale**2)
    P0[np.ix_(list(measured), list(measured))] = R
    return np.asarray(P0)


def _divided(PC: Array, S: Array) -> Array:
    """``PC S^-1``, without a solver where there is one measurement; a filter that diverged stays not a number."""
    if S.shape[-1] == 1:
        return np.asarray(PC / S)
    finite = np.isfinite(S).all(axis=(-2, -1), keepdims=True)
    return np.asarray(np.where(finite, PC @ np.linalg.inv(np.where(finite, S, np.eye(S.shape[-1]))), np.nan))
