"""Batched runs with everything that happens on a machine: measurements that are missing or late, and limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from .runtime import Estimate

if TYPE_CHECKING:
    from .observer import Observer

Array = npt.NDArray[np.float64]
Parameters = Mapping[str, npt.ArrayLike]


def next_estimate(observer: Observer, window: Array, u: Array, correction: Array, values: Parameters) -> Array:
    """Return the next estimate of the original states from a window, inputs and a correction; shape (..., n)."""
    n, lifting = observer.lifting.n_states, observer.lifting
    x = lifting.lift(window, values) @ observer.A[:n].T + lifting.lift_inputs(u, window, values) @ observer.B[:n].T
    return observer.runtime.clip_estimate(x + observer.runtime.clip_correction(correction) @ observer.into[:n].T)


def innovation(observer: Observer, x: Array, y: Array) -> Array:
    """Return the innovation; zero where a measurement is missing or not finite."""
    predicted = x[..., list(observer.measured)]
    return np.where(np.isfinite(y), y, predicted) - predicted


def run_carefully(observer: Observer, y: Array, u: Array, parameters: Parameters | None, wanted: Estimate) -> Array:
    """Run an observer on screened samples as `run_observer` does, with missing measurements, a delay and limits.

    While the first `delay` samples go by, what arrives was measured before the start and says nothing but where to start.

    Returns
    -------
    ndarray, shape (n_samples, batch, n)
    """
    d = min(observer.runtime.delay, len(y))
    values = {**observer.parameters, **(parameters or {})}
    x = observer.initial(y[0], parameters)
    held = observer.lifting.window.hold(x, u[0])
    corrected, earlier = _corrected(observer, x, held, y[d:], u, values, wanted)
    corrected, earlier = (
        np.concatenate([np.repeat(x[None], d, axis=0), corrected]),
        np.concatenate([np.repeat(held[None], d, axis=0), earlier]),
    )
    return _forward(observer, corrected, earlier, u, d, values)


def _corrected(
    observer: Observer, x: Array, earlier: Array, y: Array, u: Array, values: Parameters, wanted: Estimate
) -> tuple[Array, Array]:
    """Estimates as of the time of measurement, and the earlier values that their lifting reads; both (n_samples, batch, ...)."""
    lifting, K = observer.lifting, observer.controller
    x_c = np.zeros((len(x), K.n_states))
    estimates, before = np.empty((len(y), *x.shape)), np.empty((len(y), *earlier.shape))
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(len(y)):
            nu = innovation(observer, x, y[k])
            estimates[k] = x if wanted is Estimate.PREDICT else observer.runtime.clip_estimate(x + nu @ observer.filter_gain.T)
            before[k] = earlier
            window = np.concatenate([x, earlier], axis=-1)
            x = next_estimate(observer, window, u[k], x_c @ K.C.T + nu @ K.D.T, values)
            x_c = x_c @ K.A.T + nu @ K.B.T
            earlier = lifting.window.advance(window, u[k])
    return estimates, before


def _forward(observer: Observer, x: Array, earlier: Array, u: Array, steps: int, values: Parameters) -> Array:
    """Predict row k from what row `max(k - steps, 0)` was, without correction, over as many samples as lie between."""
    lifting, x = observer.lifting, x.copy()
    rows = np.arange(len(x))
    origin, before = np.maximum(rows - steps, 0), earlier.copy()
    nothing = np.zeros((*x.shape[:-1], observer.controller.n_outputs))
    for step in range(steps):
        going = origin + step < rows
        at = np.minimum(origin + step, len(u) - 1)
        window = np.concatenate([x, before], axis=-1)
        ahead = next_estimate(observer, window, u[at], nothing, values)
        before = np.where(going[:, None, None], lifting.window.advance(window, u[at]), before)
        x = np.where(going[:, None, None], ahead, x)
    return x
