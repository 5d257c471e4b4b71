r"""A bound on the error for a set of signals: the residuals of recorded motion, combined in any way.

A recording is a signal w: the first error, the one-step residual and the noise of its measurements. With T_j the frozen
response from w to the error of state j as the observer runs, delay included, and M that to what the slopes act on
(`docs/proofs.md`),

.. math:: \|e_j\| \le \|T_j w\| + \kappa_j \|S^{-1} M w\|,

``kappa_j`` the proven gain from the latter, divided by sizes S, to what moving slopes can add to state j alone. It
holds for any slopes in their box. The right side is convex in w and the same for a later start: the largest one of all
units bounds the error for every ``sum_i a_i w_i``, ``sum_i |a_i| <= 1``, of their recordings at any times.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core import AGREED, TINY, Array, Flags, Names, Parameters, Record, frozen
from ...data import EpisodeBatch
from ...identify.free_run import recursion
from ..data import ObserverData
from ..residual import one_step_residual
from ..screen import screened
from .certificate import ReliftCertificate
from .error import ErrorSystem, ReliftScales
from .proof import proven_gain


@frozen
class SignalBound:
    """Bounds on the errors of one observer at run time, in the units of measure of the batch."""

    states: Names  # of the recordings
    units: Names
    bounds: Array  # (units, n), on RMS errors for what the recordings of a unit hold; infinite where there is none
    sizes: Array  # (n,), ranges of the states
    reason: str = ""  # why there is no bound
    outside: Names = ()  # units of which the observer refuses samples as implausible; their rows are infinite

    @property
    def cover(self) -> Array:
        """Bound on the RMS error of every state over all units but those outside, shape (n,)."""
        inside = [unit not in self.outside for unit in self.units]
        return self.bounds[inside].max(axis=0, initial=-np.inf if any(inside) else np.inf)

    @property
    def certified(self) -> bool:
        """Whether every state has a bound for all units that are not outside."""
        return bool(np.isfinite(self.cover).all())

    def percent(self) -> dict[str, float | None]:
        """Return the bound by state, percent of the range; None where there is none."""
        values = 100 * self.cover / self.sizes
        return {name: float(v) if np.isfinite(v) else None for name, v in zip(self.states, values, strict=True)}

    def facts(self) -> Record:
        """Return what goes into the metrics."""
        if not self.certified:
            return {"set_certified": False, "set_reason": self.reason}
        return {"set_certified": True, "set_bound_percent": self.percent(), "set_outside": list(self.outside)}


def signal_bound(certificate: ReliftCertificate, observer: ObserverData, batch: EpisodeBatch) -> SignalBound:
    """Bound errors for signals like those of training episodes as their sensor shows them, of which none is lost."""
    seen, units, sizes = course(observer, batch), tuple(dict.fromkeys(batch.units)), certificate.scales.error
    member = np.array([[unit == name for unit in batch.units] for name in units], dtype=float)
    member /= member.sum(axis=1, keepdims=True)

    def rms(signal: Array) -> Array:
        """Return the RMS of every channel over the episodes of every unit, shape (unit, k)."""
        inside = np.where(batch.inside[: len(signal), :, None], signal, 0.0)
        return np.sqrt(member @ (np.sum(inside**2, axis=0) / batch.lengths[:, None]))

    result = SignalBound(observer.recorded, units, np.full((len(units), len(sizes)), np.inf), sizes)
    if not certificate.certified:
        return replace(result, reason="it has no certificate at run time")
    scales = replace(ReliftScales.ones(observer), error=sizes)
    system = replace(certificate, scales=scales).system(observer)
    w = np.concatenate([seen.omega, seen.noise], axis=-1)
    frozen, acted = (rms(signal) for signal in frozen_response(system, w, seen.first))
    share = np.maximum(acted.max(axis=0), TINY)
    gains, moving = mismatch_gains(system, share), np.linalg.norm(acted / share, axis=1)[:, None]
    with np.errstate(invalid="ignore"):
        added = np.where(moving > 0, gains * moving, 0.0)
    bounds, refused = sizes * (1 + AGREED) * (frozen + added) + rms(seen.beyond), member @ seen.refused
    outside = tuple(unit for unit, some in zip(units, refused, strict=True) if some)
    bounds[[unit in outside for unit in units]] = np.inf
    reason = "" if np.isfinite(gains).all() else "what slopes can add has no proven gain"
    return replace(result, bounds=bounds, reason=reason, outside=outside)


def frozen_response(system: ErrorSystem, w: Array, first: Array) -> tuple[Array, Array]:
    """Return the scaled errors and what the slopes act on, (n_samples, batch, .), with slopes in the middle."""
    w = np.concatenate([w, np.zeros((1, *w.shape[1:]))])
    xi = recursion(system.A, system.B, first @ system.start.T, w)
    return xi @ system.C.T, xi @ system.M.T + w @ system.D.T


def mismatch_gains(system: ErrorSystem, acted: Array) -> Array:
    """Return proven gains from what the channels act on, over sizes, to what they add to each of the errors."""
    if not len(acted):
        return np.zeros(len(system.C))
    rest, top = system.mismatch(), float(acted.max())
    rest = replace(rest, B=rest.B * (acted / top), D=rest.D * (acted / top))  # else gains underflow where little moves
    alone = np.eye(len(rest.C))[..., None]
    return np.array([proven_gain(replace(rest, C=one * rest.C)) * top for one in alone])


@frozen
class Course:
    """What drove the error of an observer along recorded episodes."""

    omega: Array  # (n_samples - 1, batch, n): one-step residual
    noise: Array  # (n_samples - 1, batch, q): what the sensor shows beside the recording, as it arrives
    first: Array  # (batch, n_window): first error, with the earlier ones that the lifting reads, which equal it
    refused: Flags  # (batch,): whether the observer refuses a sample
    beyond: Array  # (n_samples, batch, n_recorded): what recorded states are beyond declared limits, by noise


def course(observer: ObserverData, batch: EpisodeBatch) -> Course:
    """Return what drove an observer along episodes; recorded states stand for the true ones."""
    inputs, at, late = batch.inputs, list(observer.measured), observer.runtime.delay
    states = batch.states.copy()
    observer.runtime.clip_estimate(states)
    values = {**observer.parameters, **observer.own(batch.parameters)}
    due = np.maximum(np.arange(len(states)) - late, 0)
    y = batch.states[due][..., at] if batch.shown is None else batch.measurements(at, arrived=False)
    # Measurements beyond the limits of their states are taken at the limit: what is left of their noise is smaller.
    samples = screened(observer, y, inputs)
    bad = ~np.isfinite(samples.y).all(axis=-1) | (samples.u != inputs).any(axis=-1)
    refused = (bad & batch.inside).any(axis=0)
    noise = np.where(np.isfinite(samples.y), samples.y, y)[:-1] - states[due][:-1][..., at]
    noise[:late] = 0.0
    omega = held_residual(observer, states, inputs, values)
    first = first_error(observer, states[0] - observer.initial(samples.y[0], values))
    return Course(omega, noise, first, refused, batch.states - states)


def held_residual(observer: ObserverData, states: Array, inputs: Array, parameters: Parameters) -> Array:
    """Return the one-step residual, shape (n_samples - 1, batch, n); values before the first sample equal it."""
    h = observer.lifting.history
    if h:
        states, inputs = (np.concatenate([np.repeat(v[:1], h, axis=0), v]) for v in (states, inputs))
    return one_step_residual(observer.lifting, observer.A, observer.B, states, inputs, parameters)


def first_error(observer: ObserverData, error: Array) -> Array:
    """Return the first error with equal earlier ones behind it, shape (batch, n_window)."""
    states = observer.lifting.states
    earlier = [states.index(name) for name, delay in observer.lifting.window.quantities if delay and name in states]
    return np.concatenate([error, error[:, earlier]], axis=1)
