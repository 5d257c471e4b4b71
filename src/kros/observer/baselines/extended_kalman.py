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
from dataclasses import field, replace

import numpy as np

from ...core import Array, Columns, DimensionError, Parameters, frozen
from ...lifting import Lifting
from ..runtime import Runtime


@frozen
class ExtendedKalman:
    """Extended Kalman filter; measured states start with the measurement's noise."""

    lifting: Lifting
    A: Array  # (n_lifted, n_lifted)
    B: Array  # (n_lifted, m), with input functions
    measured: Columns
    Q: Array  # (n, n), process noise of the original states; or (k, n, n) for k filters at once
    R: Array  # (q, q), measurement noise
    P0: Array  # (n, n), of the first estimate
    parameters: Mapping[str, float] = field(default_factory=dict)
    runtime: Runtime = field(default_factory=Runtime)  # its delay and start; limits are not used

    def run(self, y: Array, u: Array, parameters: Parameters | None = None) -> Array:
        """Predict a batch from y (n_samples, batch, q), NaN where missing, and u, shape (n_samples, batch, n)."""
        return self.run_all(y, u, parameters)[0]

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def run_all(self, y: Array, u: Array, parameters: Parameters | None) -> Array:
        """Run all filters of a stack Q (k, n, n) side by side, shape (k, n_samples, batch, n)."""
        lifting, n, C, (n_samples, batch) = self.lifting, self.lifting.n_states, list(self.measured), y.shape[:2]
        values = {**self.parameters, **(parameters or {})}
        if self.runtime.delay:
            return self._late(y, u, values)
        Q = self.Q.reshape(-1, 1, n, n)
        x, P = np.tile(self.runtime.first(n), (len(Q), batch, 1)), np.broadcast_to(self.P0, (len(Q), batch, n, n))
        x[..., C] = np.where(np.isfinite(y[0]), y[0], 0.0)
        u = np.broadcast_to(u[:, None], (n_samples, len(Q), *u.shape[1:]))
        estimates, earlier = np.empty((n_samples, *x.shape)), None
        for sample in range(n_samples):
            estimates[sample] = x
            x, P = self._corrected(x, P, y[sample])
            earlier = lifting.window.hold(x, u[0]) if earlier is None else earlier
            window = np.concatenate([x, earlier], axis=-1)
            F = self.A[:n, :n] + self.A[:n, n:] @ lifting.slopes(window, values)[..., :n]
            x = self._ahead(window, u[sample], values)
            P = F @ P @ np.swapaxes(F, -1, -2) + Q
            P = (P + P.swapaxes(-1, -2)) / 2
            earlier = lifting.window.advance(window, u[sample])
        return np.moveaxis(estimates, 0, 1)

    def _ahead(self, window: Array, u: Array, values: Parameters) -> Array:
        """Return the next states by the model."""
        n, lifting = self.lifting.n_states, self.lifting
        return lifting.lift(window, values) @ self.A[:n].T + lifting.lift_inputs(u, window, values) @ self.B[:n].T

    def _corrected(self, x: Array, P: Array, y: Array) -> tuple[Array, Array]:
        """Return estimate and covariance with a measurement; one of which a channel is missing is left out whole."""
        C = list(self.measured)
        PC, nu, lost = P[..., C], y - x[..., C], np.asarray(~np.isfinite(y).all(axis=-1, keepdims=True))
        S = PC[..., C, :] + self.R
        L, nu = np.where(lost[..., None], 0.0, PC @ np.linalg.inv(S)), np.where(lost, 0.0, nu)
        return x + (L @ nu[..., None])[..., 0], P - L @ PC.swapaxes(-1, -2)

    def _late(self, y: Array, u: Array, values: Parameters) -> Array:
        """Run on what was measured, and predict each estimate to the row in which it is there."""
        d = min(self.runtime.delay, len(y) - 1)
        if self.lifting.history:
            raise DimensionError(
                f"Extended Kalman filter: a delay of {d} samples needs present values, found {self.lifting.functions}."
            )
        x = replace(self, runtime=replace(self.runtime, delay=0)).run_all(y[d:], u[: len(u) - d], values)
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
    return P0
