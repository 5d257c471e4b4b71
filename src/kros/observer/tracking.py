r"""A phase-locked loop: a lifting parameter, such as a gearbox's phase, follows the machine.

With the parameter p of the running observer, the sensitivity ``s = d x_hat / d p`` obeys the linearised observer
itself,

    s+ = (A_s + a sigma_x) s + a sigma_p - (into D^c C)_s s + (into C^c)_s s_c,      s_c+ = A^c s_c - B^c C s,

and ``psi = C s`` says how the predicted measurement moves with p, delays of the machine included: for ``sin(100
position + phase)`` it is the cosine of the gearbox angle, filtered as the machine filters it, whichever way it turns.
The innovation times psi is integrated with a small gain,

    p+ = p + (dt / tau) psi nu / r,      r the mean of psi^2 over about tau,

so that an error of p decays in the time tau while psi is excited, the integrand kept within 1. Several measurements
count in units of their sizes in training.

References
----------
L. Ljung and T. Soderstrom, Theory and Practice of Recursive Identification, MIT Press 1983, section 3.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..core import Array, ArrayLike, ConfigError, Flags, Whole
from .data import ObserverData
from .simulate import run_observer
from .step import Steps

MOST = 1.0  # largest error of the parameter that is corrected at once: transients at the start show more


class PhaseLockedLoop:
    """The loop beside an observer's `Steps`, for a batch of machines."""

    def __init__(self, observer: ObserverData, name: str, batch: int, settle_s: float | None = None) -> None:
        settle_s = 2_000 * observer.sample_period_s if settle_s is None else settle_s
        lifting = observer.lifting
        of_inputs = any(name in formula.used for formula in lifting.input_formulas)
        if name not in lifting.parameters or lifting.history or of_inputs or observer.runtime.delay:
            raise ConfigError(
                f"Phase-locked loop of {observer.name}: needs functions of present states with the parameter {name!r}, "
                f"found {lifting.parameters}, a history of {lifting.history} and a delay of {observer.runtime.delay}."
            )
        if not settle_s > 0:
            raise ConfigError(
                f"Phase-locked loop of {observer.name}: settle_s should be positive, found {settle_s:g} s."
            )
        n = lifting.n_states
        self.observer, self.name, self.forget = observer, name, min(observer.sample_period_s / settle_s, 1.0)
        self._sizes = measurement_sizes(observer)
        self._model, self._into, self._C = observer.A[:n], observer.into[:n], list(observer.measured)
        self._s, self._s_c = np.zeros((batch, n)), np.zeros((batch, observer.controller.n_states))
        self._power, self._weight = np.zeros(batch), np.zeros(batch)

    def begin(self, machines: Flags | None = None) -> None:
        """Start all machines, or some, again; the parameter stays."""
        for array in (self._s, self._s_c, self._power, self._weight):
            array[slice(None) if machines is None else machines] = 0.0

    def step(self, steps: Steps, y: Array, u: Array) -> Array:
        """Move the observer on by a sample, and return the parameter for the next one, shape (batch,)."""
        K, n, values = self.observer.controller, self._model.shape[0], steps.values
        x, psi = steps.x.copy(), self._s[:, self._C].copy()
        nu = np.where(np.isfinite(y), steps.innovation(y), 0.0)
        slopes = steps.lifting.slopes(x, values, (*steps.lifting.states, self.name))
        steps.step(y, u)
        if self.observer.bank is not None:  # measurements take the place of estimates
            self._s[:, self._C] = 0.0
        lifted = np.concatenate([self._s, (slopes[..., :n] @ self._s[..., None])[..., 0] + slopes[..., n]], axis=-1)
        moved = lifted @ self._model.T + (self._s_c @ K.C.T - psi @ K.D.T) @ self._into.T
        self._s, self._s_c = moved, self._s_c @ K.A.T - psi @ K.B.T
        self._power += self.forget * (np.sum((psi / self._sizes) ** 2, axis=-1) - self._power)
        self._weight += self.forget * (1.0 - self._weight)  # over the mean of psi^2 so far
        pull = np.sum(psi * nu / self._sizes**2, axis=-1) * self._weight
        usable = (self._power > 0) & np.isfinite(pull) & ~steps.waiting
        seen = np.divide(pull, self._power, out=np.zeros_like(pull), where=usable)
        return values[self.name] + self.forget * np.clip(seen, -MOST, MOST)


def measurement_sizes(observer: ObserverData) -> Array:
    """Return by what measurements are divided where they count together, shape (q,): sizes seen in training."""
    if len(observer.measured) == 1:
        return np.ones(1)
    if observer.seen is None:
        raise ConfigError(
            f"Phase-locked loop of observer {observer.name}: {len(observer.measured)} measurements count in units of "
            "their sizes, which it does not know; give it Observer(..., seen=Seen(measured, inputs))."
        )
    return np.where(observer.seen.measured > 0, observer.seen.measured, 1.0)


def least_innovation(
    observer: ObserverData,
    y: Array,
    u: Array,
    lengths: Whole,
    parameters: Mapping[str, float],
    name: str,
    candidates: ArrayLike,
) -> float:
    """Return the candidate of a parameter with the smallest innovation over episodes of one machine."""
    values, batch, k = np.asarray(candidates, dtype=float), y.shape[1], np.arange(len(y))[:, None]
    counted = np.isfinite(y) & ((k >= lengths // 4) & (k < lengths))[..., None]
    y, u = (np.tile(signal, (1, len(values), 1)) for signal in (y, u))
    own = {**observer.own(parameters), name: np.repeat(values, batch)}
    error = ((y - run_observer(observer, y, u, own)[..., list(observer.measured)]) / measurement_sizes(observer)) ** 2
    counted = np.tile(counted, (1, len(values), 1))
    return float(values[np.argmin(np.where(counted, error, 0.0).reshape(len(y), len(values), -1).sum(axis=(0, 2)))])
